"""Run a plant file freely along a recording: only its first samples are used, for the start levels.

What is printed is the error of the whole run, the first samples included, in each sensor's unit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.config.plant import load_plant
from fdi_torch.config.recordings import RecordingConfig, read_recording
from fdi_torch.gap.prediction import START_SAMPLES, predict
from fdi_torch.parameters import display_unit


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", help="CSV or MCAP file whose columns are named as the plant's channels")
    parser.add_argument("--plant", metavar="NAME|FILE", required=True, help="a shipped plant, or a plant file")
    parser.add_argument(
        "--start-samples", metavar="N", type=int, default=START_SAMPLES, help=f"for the start levels ({START_SAMPLES})"
    )
    parser.add_argument("--from", metavar="S", dest="start", type=float, help="first time used, s")
    parser.add_argument("--to", metavar="S", dest="stop", type=float, help="last time used, s")


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    torch.set_num_threads(1)
    plant = load_plant(arguments.plant)
    config = RecordingConfig(file=arguments.recording, start=_seconds(arguments.start), stop=_seconds(arguments.stop))
    recording = read_recording(config, plant, Path.cwd())
    found = predict(plant, recording, arguments.start_samples)
    rows = []
    for sensor in plant.sensors:
        unit, scale = display_unit(sensor.unit)
        rows.append([sensor.name, f"{scale * found.rmse[sensor.name]:.4g}", unit])
    screen.say(f"free run of {plant.name} along {recording.source}, {len(recording)} samples")
    screen.table("error", ("sensor", "RMSE", "unit"), rows)
    levels = ", ".join(f"{tank} {100 * level:.1f} cm" for tank, level in found.start_levels.items())
    screen.say(f"start levels, from the first {arguments.start_samples} samples: {levels}")
    screen.result(
        {
            "format": "fdi_torch.prediction/1",
            "plant": plant.name,
            "rmse": dict(found.rmse),
            "start_levels": dict(found.start_levels),
            "start_samples": arguments.start_samples,
            "time": recording.time.tolist(),
            "readings": {s.name: found.readings[:, i].tolist() for i, s in enumerate(plant.sensors)},
        }
    )
    return DONE


def _seconds(value: float | None) -> str | None:
    return None if value is None else f"{value} s"
