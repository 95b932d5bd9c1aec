"""Follow a recording: alarms, which fault since when and how large, and recoveries, one line an event."""

from __future__ import annotations

import argparse
import time

import orjson

from fdi_torch.cli.options import add_config
from fdi_torch.cli.screen import Screen
from fdi_torch.config.monitor import load_monitor
from fdi_torch.config.recordings import read_recording
from fdi_torch.monitor.following import MonitorState
from fdi_torch.monitor.online import Monitor
from fdi_torch.monitor.prepare import Prepared, fault_free_part, prepare
from fdi_torch.monitor.samples import Samples, take

CHUNK = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, required=True)


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    wanted = load_monitor(arguments.config, arguments.set)
    config, plant = wanted.config, wanted.plant
    recording = read_recording(config.recording, plant, wanted.base)
    began = time.monotonic()
    prepared = prepare(
        plant,
        fault_free_part(recording, *config.fault_free),
        config.faults,
        config.calibrate,
        config.detector,
        config.false_alarms_every,
        config.window.settings(),
        config.step,
        config.seed,
        config.recording.start_levels,
        config.ranges,
    )
    _introduce(prepared, screen)
    samples = take(recording, plant)
    events = follow(prepared.monitor, prepared.monitor.start(samples, prepared.believed), samples, screen)
    spent, lasted = time.monotonic() - began, float(samples.time[-1] - samples.time[0])
    screen.note(f"{lasted:g} s of recording in {spent:.1f} s" + ("" if spent < lasted else "; slower than real time"))
    if not events:
        screen.say("no alarm")
    return 0


def follow(monitor: Monitor, state: MonitorState, samples: Samples, screen: Screen) -> int:
    """Prints each event as it comes, as text or as one line of JSON; how many there were."""
    count = 0
    with screen.progress("following") as advance:
        for first in range(1, len(samples), CHUNK):
            last = min(first + CHUNK, len(samples))
            state, events = monitor.advance(state, samples.stretch(first, last))
            advance(last / len(samples), f"{float(samples.time[last - 1]):g} s")
            for event in events:
                screen.say(event.line)
                if screen.json:
                    screen.line(orjson.dumps({"format": "fdi_torch.event/1", **event.to_dict()}).decode())
            count += len(events)
    return count


def _introduce(prepared: Prepared, screen: Screen) -> None:
    noise, detector = prepared.noise, prepared.monitor.detector
    stds = ", ".join(f"{std:.3g}" for std in noise.reading_std.tolist())
    screen.note(
        f"noise of the readings {stds} (SI), levels wander {noise.ratio:.2g} times as much a sample, residual coloured "
        f"to order {noise.whitening.order}; {detector.chart} above {detector.threshold:.3g}; observer errors shrink to "
        f"{prepared.radius:.4f} a sample at least"
    )
    for name, value in prepared.calibrated.items():
        screen.note(f"calibrated {name} = {value:.5g}")
