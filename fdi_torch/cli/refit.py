"""`fdi refit`: what it does and prints. Its options: `options/refit.py`.

Path: cli.refit.run → config.loaded_recordings.named_recordings → gap.free_runs.refit.refit →
cli.adoption.write_adopted → gap.free_runs.prediction.leave_one_file_out
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from fdi_torch.cli.adoption import expect_adoptable, write_adopted
from fdi_torch.cli.explained import exit_code, say_doubts, say_first
from fdi_torch.cli.screen import Screen
from fdi_torch.config.loaded_recordings import named_recordings
from fdi_torch.config.plant_file import chosen_plant
from fdi_torch.estimate.misfit import misfit_of
from fdi_torch.gap.free_runs.prediction import LeftOutRun, leave_one_file_out, predicted_beside
from fdi_torch.gap.free_runs.refit import refit
from fdi_torch.jobs.gap import one_thread
from fdi_torch.jobs.python_results import RefitResult, error_table
from fdi_torch.names import counted
from fdi_torch.quantities import parse_level_deviation
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

    without_its_file, trials = arguments.leave_one_file_out, list[LeftOutRun]()
    with one_thread():
        with screen.progress("refit") as advance:
            fitted = fitted_to(recordings, tell=advance)
        misfit = misfit_of(fitted.rmse, recordings, plant)
        doubts = doubts_about([*recordings, *holdouts], plant)
        say_doubts(doubts, screen)
        say_first(misfit, screen, DISTURBED)
        result = RefitResult(fitted, misfit, plant, doubts)
        screen.show(result.errors(), result.table())
        screen.say(f"{counted(fitted.parameters, 'value')} fitted, including initial levels")
        screen.points(result.remarks())
        screen.show(result.by_recording())
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
        start: dict[str, Any] = {"start_samples": arguments.start_samples, "settle": arguments.settle}
        if without_its_file:
            with screen.progress("leave-one-file-out validation") as start["progress"]:
                files = (recordings, holdouts or recordings)
                trials = leave_one_file_out(plant, *files, lambda others: fitted_to(others).plant, **start)
            screen.show(error_table(trials, plant, "refitted: without the file of the run"))
        elif holdouts:
            with screen.progress("hold-out") as start["progress"]:
                trials = predicted_beside((plant, fitted.plant), holdouts, **start)
            screen.show(error_table(trials, plant, "refitted: to the recordings above"))
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
            "leave_one_file_out": trials if without_its_file else [],
            "holdout": [] if without_its_file else trials,
        }
    )
    return exit_code(misfit)
