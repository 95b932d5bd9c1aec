"""`fdi monitor`: what it does and prints. Its options: `options/monitor.py`."""

from __future__ import annotations

import argparse

import orjson

from fdi_torch.cli.outlets import Publish, outlets
from fdi_torch.cli.screen import Screen
from fdi_torch.config.monitor_file import load_monitor
from fdi_torch.jobs.logged_monitor import MonitorCallbacks
from fdi_torch.jobs.monitor import run_monitor
from fdi_torch.monitor.events import FORMAT, Event
from fdi_torch.monitor.monitor_setup import PreparedMonitor
from fdi_torch.parameters import quantity_text


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    folder = [f"output.folder={arguments.out}"] if arguments.out else []
    url = [f"source.url={arguments.source}"] if arguments.source else []
    monitor_run = load_monitor(arguments.config, [*arguments.set, *folder, *url])
    with (
        screen.progress("monitor") as advance,
        outlets(arguments, monitor_run.name, screen) as (
            listener,
            publish,
        ),
    ):
        callbacks = MonitorCallbacks(
            advance, lambda e: _show_event(e, screen, publish), lambda p: _show_setup(p, screen), listener
        )
        done = run_monitor(monitor_run, callbacks, arguments.follow, arguments.idle, arguments.resume)
    slow = "" if done.spent < done.lasted else "; slower than real time"
    screen.note(f"{done.lasted:g} s of recording processed in {done.spent:.1f} s{slow}; log: {done.log}")
    if not done.events:
        screen.say("no alarm")
    return 0


def _show_event(event: Event, screen: Screen, publish: Publish) -> None:
    if event.announced:
        screen.say(event.line)
    data = {"format": FORMAT, **event.to_dict()}
    screen.line(orjson.dumps(data).decode())
    publish(data)


def _show_setup(prepared: PreparedMonitor, screen: Screen) -> None:
    """Print the noise model, the detector and the calibrated constants."""
    noise, detector = prepared.noise, prepared.monitor.detector
    stds = ", ".join(
        f"{sensor.name} {quantity_text(std, sensor.unit, 3, sensor.column)}"
        for sensor, std in zip(prepared.monitor.network.description.sensors, noise.reading_std.tolist(), strict=True)
    )
    process = "" if noise.ratio != noise.ratio else f", process noise per sample {noise.ratio:.2g} times that"
    screen.note(
        f"noise of the readings: {stds}{process}, residual autocorrelated to order {noise.whitening.order}; "
        f"{detector.chart} threshold {detector.threshold:.3g}; observer errors decay by a factor of "
        f"{prepared.radius:.4f} per sample"
    )
    for name, value in prepared.calibrated.items():
        screen.note(f"calibrated {name} = {value:.5g}")
