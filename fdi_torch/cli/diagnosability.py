"""`fdi diagnosability`: what it does and prints. Its options: `options/diagnosability.py`.

Path: cli.diagnosability.run → monitor.monitor_setup.usual_faults → monitor.diagnosability.diagnosability
"""

from __future__ import annotations

import argparse
import math
from itertools import combinations
from pathlib import Path

import torch

from fdi_torch.cli.screen import Screen
from fdi_torch.config.loaded_recordings import planned_recordings
from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.config.simulation import reading_noise
from fdi_torch.effects import full_name
from fdi_torch.effects.usual_faults import usual_faults
from fdi_torch.monitor.diagnosability import Diagnosability, diagnosability
from fdi_torch.plant.description import PlantDescription, uncertain_constants
from fdi_torch.plant.scales import time_scale
from fdi_torch.quantities import display_unit, parse_quantity
from fdi_torch.recording import Recording
from fdi_torch.tables import Table

CLOSE = 0.1
"""Sine of an angle below which a pair is listed: it is isolable only from ten times the detectable size on."""


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    plant = chosen_plant(arguments.plant)
    faults = [full_name(name, plant) for name in arguments.faults] or usual_faults(plant)
    recording, constant = _inputs(arguments, plant)
    uncertain = uncertain_constants(plant, faults)
    report = diagnosability(
        plant,
        faults,
        recording,
        torch.tensor(reading_noise(arguments.noise, plant), dtype=torch.float64),
        calibrate=uncertain,
        start="equilibrium" if constant else "free",
    )
    if uncertain:
        screen.say(f"uncertain within their tolerances: {', '.join(uncertain)}")
    _show(report, screen, arguments.angles)
    screen.result({"format": "fdi_torch.diagnosability/1", **report.to_dict()})
    return 0


def _inputs(arguments: argparse.Namespace, plant: PlantDescription) -> tuple[Recording, bool]:
    """A recording with the inputs, and whether they are constant ones from the command line."""
    if Path(arguments.input).exists():
        recordings = planned_recordings(arguments.input, plant, Path.cwd())
        if len(recordings) > 1:
            raise ValueError(
                f"--input: expected one recording with known inputs, got {len(recordings)} in {arguments.input}; "
                "name one file there, and select a part with start and stop"
            )
        return recordings[0], False
    units = plant.channel_units()
    amounts = arguments.input.split(",")
    if len(amounts) != len(units):
        expected = ", ".join(f"{name} in {unit}" for name, unit in units.items())
        raise ValueError(f"--input: expected a file or {len(units)} amounts ({expected}), got '{arguments.input}'")
    values = [parse_quantity(text.strip(), unit) for text, unit in zip(amounts, units.values(), strict=True)]
    step = time_scale(plant)
    duration = 1000.0 * step if arguments.duration is None else arguments.duration
    time = torch.arange(0.0, duration + 0.5 * step, step, dtype=torch.float64)
    inputs = torch.tensor(values, dtype=torch.float64).expand(len(time), len(values))
    return plant.recording(time, inputs, time.new_zeros(len(time), len(plant.sensors))), True


def _show(report: Diagnosability, screen: Screen, all_angles: bool) -> None:
    """Print which faults are determined and which only together, then sizes and signatures."""
    count, determined = len(report.faults), sum(map(math.isfinite, report.std))
    screen.say(f"{report.rank} of {count} faults (or combinations) are determined together")
    if determined < count:
        screen.say(f"{determined} of {count} faults are determined by themselves")
    screen.points((*report.groups, *report.remarks))
    screen.say()
    columns = (report.std, report.std_by_correlation, report.smallest_detectable, report.smallest_isolable)
    rows, shows = [], []
    for name, si_unit, seen, *values in zip(report.faults, report.units, report.shows, *columns, strict=True):
        unit, scale = display_unit(si_unit, name)
        rows.append([name, unit or "1", *(scale * value for value in values)])
        shows.append([name, unit or "1", *(value / scale for value in seen)])
    header = ("fault", "unit", "std error", "by correlation", "smallest detectable", "smallest isolable")
    screen.show(Table(header, rows, digits=3))
    screen.say()
    screen.say("std error: of all faults estimated together; by correlation: with the correlation as objective")
    screen.say("–: not determined by these inputs, or not at any size within the fault's range")
    screen.say()
    effect = "effect of one unit of each fault on each sensor"
    title = f"{effect}, in standard deviations of its noise (all samples together)"
    screen.show(Table(("fault", "unit", *report.sensors), shows, title, digits=3))
    screen.say()
    _show_angles(report, screen, all_angles)


def _show_angles(report: Diagnosability, screen: Screen, all_pairs: bool) -> None:
    """Print the sines of the angles between signatures: of all pairs as a matrix, or of pairs that nearly coincide."""
    if not all_pairs:
        detectable = [k for k, size in enumerate(report.smallest_detectable) if math.isfinite(size)]
        close = [(report.apart[i][j], i, j) for i, j in combinations(detectable, 2) if report.apart[i][j] < CLOSE]
        close.sort(key=lambda pair: round(pair[0], 3))
        rows = [[report.faults[i], report.faults[j], f"{sine:.3f}"] for sine, i, j in close]
        title = f"pairs that are hard to distinguish: sine of the angle between their signatures below {CLOSE:g}"
        screen.show(Table(("fault", "other fault", "sine"), rows, title, words=2))
        if not rows:
            screen.say(f"no two signatures are at an angle with a sine below {CLOSE:g}")
        return
    angles = enumerate(zip(report.faults, report.apart, strict=True), 1)
    apart = [[str(i), name, *(f"{v:.2f}" for v in row)] for i, (name, row) in angles]
    title = "sine of the angle between signatures (0: not distinguishable)"
    screen.show(Table(("", "fault", *(row[0] for row in apart)), apart, title, words=2))
