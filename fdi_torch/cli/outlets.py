"""Where `fdi monitor` sends what happens, beside terminal and log: a live view, metrics, and a broker."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from fdi_torch.cli.options import access_text, live
from fdi_torch.cli.screen import Screen
from fdi_torch.logbook import Listener
from fdi_torch.logbook.channel import Channel

Publish = Callable[[dict[str, Any]], None]


@contextmanager
def outlets(arguments: argparse.Namespace, name: str, screen: Screen) -> Iterator[tuple[Listener | None, Publish]]:
    """The listener of the log and the publisher of events that --live, --metrics and --publish ask for."""
    with ExitStack() as stack:
        listeners: list[Listener] = []
        if (viewer := stack.enter_context(live(arguments, name, screen))) is not None:
            listeners.append(viewer)
        if arguments.metrics is not None:
            listeners.append(stack.enter_context(_metrics(arguments.metrics, screen)))
        publish: Publish = stack.enter_context(_publisher(arguments.publish)) if arguments.publish else _nowhere
        yield (_to_all(listeners) if listeners else None), publish


@contextmanager
def _metrics(wish: str, screen: Screen) -> Iterator[Listener]:
    from fdi_torch.live.metrics import serve_metrics

    host, _, port = wish.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) < 2**16):
        raise ValueError(f"--metrics: expected [HOST:]PORT such as 127.0.0.1:9464, got {wish}")
    host = host or "127.0.0.1"
    with serve_metrics(host, int(port)) as metrics:
        screen.note(f"metrics: http://{host}:{metrics.port}/metrics ({access_text(host)})")
        yield metrics


@contextmanager
def _publisher(url: str) -> Iterator[Publish]:
    from fdi_torch.live.address import address_of
    from fdi_torch.live.mqtt import EventPublisher

    try:
        publisher = EventPublisher(address_of(url, ("mqtt", "mqtts")))
    except ValueError as error:
        raise ValueError(f"--publish: {error}") from error
    with publisher:
        yield publisher.publish


def _nowhere(event: dict[str, Any]) -> None:
    """Publish nothing."""


def _to_all(listeners: list[Listener]) -> Listener:
    def listen(channel: Channel, log_time: int, data: bytes) -> None:
        for listener in listeners:
            listener(channel, log_time, data)

    return listen
