"""`fdi monitor`: what it does and prints. Its options: `options/monitor.py`.

Path: cli.monitor.run → config.monitor_file.load_monitor → jobs.monitor.run_monitor →
jobs.logged_monitor.LoggedMonitor.learn → monitor.monitor_setup.prepare_monitor → monitor.noise_model.learn_noise →
monitor.detection.make_detector → monitor.monitor.Monitor.advance → monitor.isolation.isolate
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, get_args

import orjson

from fdi_torch.cli.options import access_text, host_and_port, live, overrides
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.clock import clock_text
from fdi_torch.config.monitor_file import load_monitor
from fdi_torch.jobs.logged_monitor import MonitorCallbacks
from fdi_torch.jobs.monitor import run_monitor
from fdi_torch.logbook import Listener
from fdi_torch.logbook.topic_definitions import Channel
from fdi_torch.monitor.events import FORMAT, Event, Kind
from fdi_torch.monitor.monitor_setup import PreparedMonitor
from fdi_torch.quantities import quantity_text

Publish = Callable[[dict[str, Any]], None] | None


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    monitor_run = load_monitor(arguments.config, overrides(arguments))
    with screen.progress("monitor") as advance, outlets(arguments, monitor_run.name, screen) as (listener, publish):
        callbacks = MonitorCallbacks(
            advance, lambda e: _show_event(e, screen, publish), lambda p: _show_setup(p, screen), listener, screen.note
        )
        done = run_monitor(monitor_run, callbacks, arguments.follow, arguments.idle, arguments.resume)
    slow = "" if done.spent < done.lasted else "; slower than real time"
    screen.note(f"{done.lasted:g} s of recording processed in {done.spent:.1f} s{slow}; {log_words(done.log)}")
    if not done.alarms:
        screen.say("no alarm")
    return 0


def _show_event(event: Event, screen: Screen, publish: Publish) -> None:
    moment, onset = (clock_text(t) if t is not None else "" for t in (event.time, event.onset))
    if event.announced:
        screen.say(event.line, indent=len(event.head))
    data = {"format": FORMAT, **event.to_dict()}
    data |= {"clock": moment, "onset_clock": onset or None} if moment else {}
    screen.line(orjson.dumps(data).decode())
    if publish is not None:
        publish(data)


def _show_setup(prepared: PreparedMonitor, screen: Screen) -> None:
    """Print the noise model, the detector and the calibrated constants."""
    noise, detector = prepared.monitor.noise, prepared.monitor.detector
    stds = ", ".join(
        f"{sensor.name} {quantity_text(std, sensor.unit, 3, sensor.column)}"
        for sensor, std in zip(prepared.monitor.network.description.sensors, noise.reading_std.tolist(), strict=True)
    )
    order = noise.whitening.order
    memory = f"each residual depends on the {order} before it" if order else "successive residuals are independent"
    screen.note(
        f"noise of the readings: {stds}; random drift of the levels per sample: {noise.ratio:.2g} times that; "
        f"{memory}; alarm when the {detector.chart} statistic exceeds {detector.threshold:.3g}"
    )
    for name, value in prepared.calibrated.items():
        screen.note(f"calibrated {name} = {value:.5g}")


@contextmanager
def outlets(arguments: argparse.Namespace, name: str, screen: Screen) -> Iterator[tuple[Listener | None, Publish]]:
    """The listener of the log and the publisher of events that --live, --metrics and --publish ask for."""
    with ExitStack() as stack:
        listeners: list[Listener] = []
        if (viewer := stack.enter_context(live(arguments, name, screen))) is not None:
            listeners.append(viewer)
        if arguments.metrics is not None:
            listeners.append(stack.enter_context(_metrics(arguments.metrics, screen)))
        publish = stack.enter_context(_publisher(arguments.publish)) if arguments.publish else None

        def listen(channel: Channel, log_time: int, data: bytes) -> None:
            for listener in listeners:
                listener(channel, log_time, data)

        yield (listen if listeners else None), publish


@contextmanager
def _metrics(wish: str, screen: Screen) -> Iterator[Listener]:
    from fdi_torch.live.metrics import serve_metrics

    host, port = host_and_port("--metrics", wish, "127.0.0.1:9464")
    with serve_metrics(host, port, get_args(Kind)) as metrics:
        screen.note(f"metrics: http://{host}:{metrics.port}/metrics ({access_text(host)})")
        yield metrics


@contextmanager
def _publisher(url: str) -> Iterator[Publish]:
    from fdi_torch.live.mqtt import EventPublisher
    from fdi_torch.live.values import address_of

    try:
        publisher = EventPublisher(address_of(url, ("mqtt", "mqtts")))
    except ValueError as error:
        raise ValueError(f"--publish: {error}") from None
    with publisher:
        yield publisher.publish
