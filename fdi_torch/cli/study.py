"""`fdi study`: what it does and prints. Its options: `options/study.py`.

Path: cli.study.run → config.study_file.load_study → jobs.study.run_study → study.monte_carlo.run_blocks (or
study.cluster.run_on_cluster) → study.monte_carlo.make_trials → study.summary.summarise
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import live, overrides
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.config.study_file import load_study
from fdi_torch.jobs.study import StudyResult, run_study
from fdi_torch.names import counted
from fdi_torch.plant.exact_constants import exact_constants_sentence
from fdi_torch.report.setting_tables import LEGEND, isolation_sentence


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    study = load_study(arguments.config, overrides(arguments))
    with live(arguments, study.run.name, screen) as listener, screen.progress(study.run.name) as advance:
        advance(0.0, f"{study.plan.trials} trials")
        result = run_study(study, arguments.resume, arguments.cluster, advance, listener)
    fitting = study.plan.fitting
    constants = fitting.networks[0].constants.names
    show(result, screen, exact_constants_sentence(study.run.plant, fitting.space.names, constants))
    numbers = {"settings": result.summaries, "isolation": result.isolation, "computed": result.computed}
    screen.result({"format": "fdi_torch.study/1", **numbers, "seconds": result.seconds, "log": str(result.log)})
    return 0


def show(result: StudyResult, screen: Screen, remark: str = "") -> None:
    """Print a table per setting, a remark on them, the isolation of modes, and the path of the log."""
    tables = result.tables(brief=True)
    for table in tables:
        screen.show(table)
        screen.say()
    if len(tables) == len(result.summaries):
        screen.say(LEGEND)
        if any(len(short) < len(whole) for short, whole in zip(tables, result.tables(), strict=True)):
            screen.say(f"of each estimator but the first, the worst parameter; all: fdi report {result.log}")
    if remark:
        screen.say(remark)
    if result.isolation is not None:
        screen.say(isolation_sentence(vars(result.isolation)))
    per_trial = f", {1e3 * result.seconds / result.computed:.0f} ms each" if result.computed else ""
    screen.say(f"{counted(result.computed, 'trial')} in {result.seconds:.0f} s{per_trial}")
    screen.say(log_words(result.log))
