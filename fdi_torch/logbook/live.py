"""Live view of a running job by the Foxglove WebSocket protocol. Only this file imports foxglove (extra `live`).

Messages are sent as they are logged: the same topics, schemas, metadata and payloads, with plant time as the time. A
viewer that connects late first receives the latest messages of each topic to which it subscribes.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fdi_torch.logbook.topic_definitions import Channel

PORT = 8765
KEPT = 20_000  # latest messages of a channel, for viewers that connect late
BACKLOG = 200_000  # unsent messages of one viewer, beyond which the oldest are dropped


class Live:
    """Listener that forwards logged messages. Created by `serve`."""

    def __init__(self, foxglove: Any) -> None:
        self._foxglove = foxglove
        self.context = foxglove.Context()
        self._lock = threading.Lock()
        self._numbers: dict[Channel, int] = {}
        self._by_number: dict[int, tuple[Any, deque[tuple[int, bytes]]]] = {}
        self.address = ""

    def __call__(self, channel: Channel, log_time: int, data: bytes) -> None:
        number = self._numbers.get(channel) or self._advertise(channel)
        channel_on_server, sent = self._by_number[number]
        with self._lock:
            sent.append((log_time, data))
        channel_on_server.log(data, log_time=log_time)

    def catch_up(self, viewer: int, number: int) -> None:
        """Send a viewer the stored messages of the channel to which it subscribes."""
        with self._lock:
            channel_on_server, sent = self._by_number[number]
            missed = list(sent)
        for log_time, data in missed:
            channel_on_server.log(data, log_time=log_time, sink_id=viewer)

    def _advertise(self, channel: Channel) -> int:
        """Advertise a channel to viewers. Returns its number."""
        with self._lock:  # a viewer that subscribes at once waits until its channel is registered
            made = self._foxglove.Channel(
                channel.topic,
                schema=self._foxglove.Schema(
                    name=channel.schema_name, encoding=channel.schema_encoding, data=channel.schema_data
                ),
                message_encoding=channel.encoding,
                metadata=dict(channel.metadata),
                context=self.context,
            )
            number = int(made.id())
            self._numbers[channel] = number
            self._by_number[number] = (made, deque(maxlen=KEPT))
        return number


@contextmanager
def serve(name: str, host: str = "127.0.0.1", port: int = PORT) -> Iterator[Live]:
    """A server during the block; `address` is the URL for viewers. port 0: any free port.

    Raises ValueError if the extra is not installed, or the address is not available.
    """
    try:
        import foxglove
        from foxglove.websocket import ServerListener
    except ImportError:
        raise ValueError("--live: expected the extra 'live', got none; pip install 'fdi_torch[live]'") from None
    live = Live(foxglove)

    class Listener(ServerListener):
        def on_subscribe(self, client: Any, channel: Any) -> None:
            live.catch_up(client.id, channel.id)

    try:
        server = foxglove.start_server(
            name=name,
            host=host,
            port=port,
            context=live.context,
            server_listener=Listener(),
            message_backlog_size=BACKLOG,
        )
    except (RuntimeError, OverflowError, TypeError) as error:
        raise ValueError(f"--live: expected a free address, got {host}:{port} ({error}); name another port") from None
    live.address = f"ws://{host}:{server.port}"
    try:
        yield live
    finally:
        server.stop()
