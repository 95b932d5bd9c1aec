"""`fdi refit`: what it does and prints. Its options: `options/refit.py`.

Path: cli.refit.run → config.loaded_recordings.named_recordings → gap.free_runs.refit.refit →
cli.adoption.write_adopted → gap.free_runs.prediction.leave_one_file_out
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from fdi_torch.amounts import end_words, rounded
from fdi_torch.cli.adoption import expect_adoptable, write_adopted
from fdi_torch.cli.explained import exit_code, say_doubts, say_first
from fdi_torch.cli.gap_text import MOVED
from fdi_torch.cli.screen import Screen
from fdi_torch.config.loaded_recordings import named_recordings
from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.effects import build_network
from fdi_torch.estimate.misfit import misfit_of
from fdi_torch.estimate.uncertainty import parameters_at_bounds
from fdi_torch.gap.free_runs.between_runs import between_run_spread
from fdi_torch.gap.free_runs.prediction import LeftOutRun, leave_one_file_out, predicted_beside
from fdi_torch.gap.free_runs.refit import Refit, refit
from fdi_torch.jobs.gap import one_thread
from fdi_torch.names import counted
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import display_unit, parse_level_deviation
from fdi_torch.recordings.check import doubts_about

DISTURBED = (
    "the standard errors below take the residual for noise of the sensors; fdi gap --adopt FILE --narrow calibrates "
    "with random disturbances of the flows"
)


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    plant = chosen_plant(arguments.plant)
    expect_adoptable(arguments.adopt, arguments.replace)
    recordings = named_recordings(arguments.recording, plant, Path.cwd())
    holdouts = [r for name in arguments.holdout for r in named_recordings(name, plant, Path.cwd())]
    white = parse_level_deviation(arguments.white, "--white") if arguments.white else None
    a = arguments
    fitted_to = partial(refit, plant, leave_out=a.leave_out, step=a.step, hold=a.hold, white=white, vary=a.vary)

    trials: list[LeftOutRun] = []
    held_out: list[LeftOutRun] = []
    with one_thread():
        with screen.progress("refit") as advance:
            fitted = fitted_to(recordings, tell=advance)
        misfit = misfit_of(fitted.rmse, recordings, plant)
        doubts = doubts_about([*recordings, *holdouts], plant)
        say_doubts(doubts, screen)
        say_first(misfit, screen, DISTURBED)
        _show(fitted, plant, screen)
        _show_run_specific(fitted, screen)
        if arguments.adopt:
            adopted = fitted.narrowed() if arguments.narrow else fitted.plant
            errors = {name: std for name, (_, std) in fitted.fitted.items()}
            for line in write_adopted(arguments.plant, plant, adopted, Path(arguments.adopt), screen, errors):
                screen.say(line)
            screen.note(f"plant file with the fitted values: {arguments.adopt}")
            if plant.tolerances and not arguments.narrow:
                screen.say(
                    f"- next: {arguments.adopt} keeps the tolerances of {arguments.plant}; --narrow replaces them by "
                    "the standard errors of this fit, which suits constants that do not drift from day to day"
                )
        if holdouts and not arguments.leave_one_file_out:
            with screen.progress("hold-out") as advance:
                held_out = predicted_beside(
                    (plant, fitted.plant), holdouts, arguments.start_samples, advance, arguments.settle
                )
            _show_trials(held_out, plant, screen, "refitted: to the recordings above")
        if arguments.leave_one_file_out:
            with screen.progress("leave-one-file-out validation") as advance:
                trials = leave_one_file_out(
                    plant,
                    recordings,
                    holdouts or recordings,
                    lambda others: fitted_to(others).plant,
                    arguments.start_samples,
                    advance,
                    arguments.settle,
                )
            _show_trials(trials, plant, screen, "refitted: without the file of the run")
    screen.result(
        {
            "format": "fdi_torch.refit/1",
            **misfit.to_dict(),
            "doubts": doubts,
            "before": dict(fitted.before),
            "rmse": dict(fitted.rmse),
            "parameters": fitted.parameters,
            "fitted": {n: {"value": v, "std": s} for n, (v, s) in fitted.fitted.items()},
            "own": fitted.own,
            "leave_one_file_out": trials,
            "holdout": held_out,
        }
    )
    return exit_code(misfit)


def _show(result: Refit, before: PlantDescription, screen: Screen) -> None:
    """Print the errors and the fitted values beside those of the plant file `before`."""
    fits = {"constants fitted": result.before, "constants and effects fitted": result.rmse}
    if not result.plant.effects:
        fits = {"constants fitted": result.rmse}
    rows = []
    for sensor in result.plant.sensors:
        unit, scale = display_unit(sensor.unit, sensor.column)
        rows.append([sensor.name, *(f"{scale * of[sensor.name]:.4g}" for of in fits.values()), unit])
    screen.table("root mean square error", ("sensor", *fits, "unit"), rows)
    constants = build_network(before).constants
    rows, remarks = [], []
    for name, (value, error) in result.fitted.items():
        unit, scale = display_unit(constants[name].unit, name)
        numbers = [
            f"{scale * constants[name].nominal:.4g}",
            *(rounded(scale * v, scale * error) for v in (value, error)),
        ]
        rows.append([name, *numbers, "" if unit == "1" else unit])
        far = abs(value - constants[name].nominal) / constants[name].std
        if far > MOVED:
            remarks.append(f"{name} lies {far:.2g} tolerances from its value in the plant file")
    screen.table("fitted to all recordings", ("parameter", "plant file", "fitted", "std error", "unit"), rows)
    screen.say(f"{counted(result.parameters, 'value')} fitted, including initial levels")
    values = torch.tensor([value for value, _ in result.fitted.values()], dtype=torch.float64)
    ends = parameters_at_bounds(ParameterSpace([constants[name] for name in result.fitted]), values)
    screen.points([*remarks, *(end_words(*each) for each in ends.items())])


def _show_run_specific(result: Refit, screen: Screen) -> None:
    """Values that differ by recording, and their between-run variation."""
    constants = build_network(result.plant).constants
    rows = []
    for name in dict.fromkeys(own.name for own in result.own):
        unit, scale = display_unit(constants[name].unit, name)
        each = [own for own in result.own if own.name == name]
        for own in each:
            numbers = [*(rounded(scale * v, scale * own.std) for v in (own.value, own.std)), unit]
            rows.append([name, Path(own.source).name, f"{own.start:g}", *numbers])
        variation = between_run_spread(each, constants[name].std)
        if variation:
            interval = (
                f"{scale * variation.std:.2g} (95 %: {scale * variation.low:.2g} to {scale * variation.high:.2g})"
            )
            mean = f"{scale * variation.mean:.4g}"
            rows.append([name, f"mean and standard deviation of {variation.count}", "", mean, interval, unit])
    if rows:
        header = ("parameter", "recording", "from, s", "value", "std error", "unit")
        screen.table("values of each recording", header, rows)


def _show_trials(trials: Sequence[LeftOutRun], plant: PlantDescription, screen: Screen, refitted: str) -> None:
    """One line per free run: error of the plant file, and of the refitted plant. refitted: to what, in words."""
    units = {s.name: display_unit(s.unit, s.column) for s in plant.sensors}
    header = ["run", "from, s", "to, s"]
    header += [f"{name} {of}, {unit}" for of in ("as is", "refitted") for name, (unit, _) in units.items()]
    rows = []
    for trial in trials:
        both = (trial.as_is, trial.refitted)
        errors = [f"{scale * of[name]:.3g}" for of in both for name, (_, scale) in units.items()]
        rows.append([Path(trial.source).name, f"{trial.start:g}", f"{trial.stop:g}", *errors])
    screen.table(f"root mean square error of free runs; {refitted}", header, rows)
