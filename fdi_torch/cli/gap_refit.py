"""`fdi gap --refit`: nothing is searched; a plant's own effects and constants are fitted together, and tried on runs
that were not used.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.adoption import write_adopted
from fdi_torch.cli.screen import Screen
from fdi_torch.effects import build_network
from fdi_torch.gap.in_turn import Trial, in_turn
from fdi_torch.gap.refit import Refit, refit
from fdi_torch.gap.spread import spread
from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording


def run_refit(
    plant: PlantDescription,
    recordings: Sequence[Recording],
    holdouts: Sequence[Recording],
    leave_out: Collection[str],
    arguments: argparse.Namespace,
    screen: Screen,
) -> int:
    hold = [name for name in arguments.hold.split(",") if name]
    vary = [name for name in arguments.vary.split(",") if name]
    found = refit(plant, recordings, leave_out, arguments.step, hold, arguments.white, vary)
    _show(found, screen)
    _show_own(found, screen)
    if arguments.adopt:
        write_adopted(arguments.plant, plant, found.plant, Path(arguments.adopt), screen)
        screen.note(f"plant file as fitted: {arguments.adopt}")
    trials: list[Trial] = []
    if arguments.in_turn:
        with screen.progress("without each file in turn") as advance:
            trials = in_turn(
                plant,
                recordings,
                holdouts or recordings,
                lambda rest: refit(plant, rest, leave_out, arguments.step, hold, arguments.white, vary).plant,
                arguments.start_samples,
                advance,
                arguments.settle,
            )
        _show_trials(trials, plant, screen)
    screen.result(
        {
            "format": "fdi_torch.refit/1",
            "before": dict(found.before),
            "rmse": dict(found.rmse),
            "parameters": found.parameters,
            "fitted": {n: {"value": v, "std": s} for n, (v, s) in found.fitted.items()},
            "own": found.own,
            "in_turn": trials,
        }
    )
    return DONE


def _show(found: Refit, screen: Screen) -> None:
    rows = []
    for sensor in found.plant.sensors:
        unit, scale = display_unit(sensor.unit)
        rows.append([sensor.name, *(f"{scale * of[sensor.name]:.4g}" for of in (found.before, found.rmse)), unit])
    screen.table("error", ("sensor", "constants fitted", "effects too", "unit"), rows)
    constants = build_network(found.plant).constants
    rows = []
    for name, (value, error) in found.fitted.items():
        unit, scale = display_unit(constants[name].unit)
        rows.append([name, f"{scale * value:.4g}", f"{scale * error:.2g}", "" if unit == "1" else unit])
    screen.table("fitted to all recordings", ("parameter", "value", "std error", "unit"), rows)
    screen.say(f"{found.parameters} numbers fitted, start levels among them")


def _show_own(found: Refit, screen: Screen) -> None:
    """What each recording has for itself, and how much it differs from one to the next."""
    constants = build_network(found.plant).constants
    rows = []
    for name in dict.fromkeys(own.name for own in found.own):
        unit, scale = display_unit(constants[name].unit)
        each = [own for own in found.own if own.name == name]
        for own in each:
            numbers = [f"{scale * own.value:.4g}", f"{scale * own.std:.2g}", unit]
            rows.append([name, Path(own.source).name, f"{own.start:g}", *numbers])
        told = spread(each, constants[name].std)
        if told:
            interval = f"{scale * told.std:.2g} (95 %: {scale * told.low:.2g} to {scale * told.high:.2g})"
            rows.append([name, f"mean and spread of {told.count}", "", f"{scale * told.mean:.4g}", interval, unit])
    if rows:
        screen.table("each recording's own", ("parameter", "recording", "from, s", "value", "std error", "unit"), rows)


def _show_trials(trials: Sequence[Trial], plant: PlantDescription, screen: Screen) -> None:
    """One line a free run: the plant file as it is, and as refitted without that file."""
    header = ["run", "from, s", "to, s"]
    header += [f"{s.name} {of}, {display_unit(s.unit)[0]}" for of in ("as is", "refitted") for s in plant.sensors]
    rows = []
    for trial in trials:
        errors = [
            f"{display_unit(s.unit)[1] * of[s.name]:.3g}" for of in (trial.as_is, trial.refitted) for s in plant.sensors
        ]
        rows.append([Path(trial.source).name, f"{trial.start:g}", f"{trial.stop:g}", *errors])
    screen.table("root mean square error of free runs, refitted without the file that the run is of", header, rows)
