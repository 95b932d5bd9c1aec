"""A running job served over the Foxglove WebSocket protocol. The only importer of foxglove (extra `live`).

What goes into the log is sent as it is written: the same topics, schemas, metadata and payloads, with plant time as
the time. A viewer that comes late is first sent the latest messages of each topic it asks for.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fdi_torch.logbook.channel import Channel

PORT = 8765
KEPT = 20_000  # messages of a channel that a late viewer is sent
BACKLOG = 200_000  # messages on their way to one viewer, beyond which the oldest are dropped


class Live:
    """Hears what is logged and sends it on. Made by `serve`."""

    def __init__(self, foxglove: Any) -> None:
        self._foxglove = foxglove
        self.context = foxglove.Context()
        self._lock = threading.Lock()
        self._numbers: dict[Channel, int] = {}
        self._by_number: dict[int, tuple[Any, deque[tuple[int, bytes]]]] = {}
        self.address = ""

    def __call__(self, channel: Channel, log_time: int, data: bytes) -> None:
        """One message of the log."""
        number = self._numbers.get(channel) or self._advertise(channel)
        known, sent = self._by_number[number]
        with self._lock:
            sent.append((log_time, data))
        known.log(data, log_time=log_time)

    def catch_up(self, viewer: int, number: int) -> None:
        """A viewer asks for the channel of that number: it is sent what it has missed."""
        with self._lock:
            known, sent = self._by_number[number]
            missed = list(sent)
        for log_time, data in missed:
            known.log(data, log_time=log_time, sink_id=viewer)

    def _advertise(self, channel: Channel) -> int:
        """Offer a channel to viewers. Returns the number by which they ask for it."""
        with self._lock:  # a viewer that asks at once waits here until its channel is known
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
    """A server for the time of the block; its `address` is what a viewer is told to open. port 0: any free one.

    Raises ValueError where the extra is not installed, or the address cannot be had.
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
        raise ValueError(f"--live: expected a free address, got {host}:{port} ({error}); name another port") from error
    live.address = f"ws://{host}:{server.port}"
    try:
        yield live
    finally:
        server.stop()
