"""`fdi monitor`: what it does and prints. Its options: `options/monitor.py`."""

from __future__ import annotations

import argparse

import orjson

from fdi_torch.cli.options import live
from fdi_torch.cli.screen import Screen
from fdi_torch.config.monitor_file import load_monitor
from fdi_torch.jobs.monitor import Listening, watch
from fdi_torch.monitor.events import FORMAT, Event
from fdi_torch.monitor.prepare import Prepared
from fdi_torch.parameters import display_unit


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    folder = [f"output.folder={arguments.out}"] if arguments.out else []
    wanted = load_monitor(arguments.config, [*arguments.set, *folder])
    with screen.progress("following") as advance, live(arguments, wanted.name, screen) as listener:
        heard = Listening(advance, lambda e: _tell(e, screen), lambda p: _introduce(p, screen), listener)
        done = watch(wanted, heard, arguments.follow, arguments.idle, arguments.resume)
    slow = "" if done.spent < done.lasted else "; slower than real time"
    screen.note(f"{done.lasted:g} s of recording in {done.spent:.1f} s of work{slow}; log: {done.log}")
    if not done.events:
        screen.say("no alarm")
    return 0


def _tell(event: Event, screen: Screen) -> None:
    if event.announced:
        screen.say(event.line)
    screen.line(orjson.dumps({"format": FORMAT, **event.to_dict()}).decode())


def _introduce(prepared: Prepared, screen: Screen) -> None:
    noise, detector = prepared.noise, prepared.monitor.detector
    stds = ", ".join(
        f"{sensor.name} {display_unit(sensor.unit)[1] * std:.3g} {display_unit(sensor.unit)[0]}".rstrip()
        for sensor, std in zip(prepared.monitor.network.description.sensors, noise.reading_std.tolist(), strict=True)
    )
    wander = "" if noise.ratio != noise.ratio else f", levels wander {noise.ratio:.2g} times as much a sample"
    screen.note(
        f"noise of the readings: {stds}{wander}, residual coloured to order {noise.whitening.order}; "
        f"{detector.chart} above {detector.threshold:.3g}; observer errors shrink to {prepared.radius:.4f} a sample at "
        "least"
    )
    for name, value in prepared.calibrated.items():
        screen.note(f"calibrated {name} = {value:.5g}")
