"""`fdi study`: what it does and prints. Its options: `options/study.py`.

Path: cli.study.run → config.study_file.load_study → jobs.study.run_study → study.monte_carlo.run_blocks (or
study.cluster.run_on_cluster) → study.monte_carlo.make_trials → study.summary.summarise
"""

from __future__ import annotations

import argparse

from fdi_torch.amounts import with_error
from fdi_torch.cli.options import live, overrides
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.config.study_file import load_study
from fdi_torch.jobs.study import StudyResult, run_study
from fdi_torch.names import counted
from fdi_torch.quantities import significant
from fdi_torch.study.estimators import ESTIMATORS
from fdi_torch.study.summary import Isolation, Ratio, Score, Summary
from fdi_torch.tables import in_display_unit


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    study = load_study(arguments.config, overrides(arguments))
    with live(arguments, study.run.name, screen) as listener, screen.progress(study.run.name) as advance:
        advance(0.0, f"{study.plan.trials} trials")
        result = run_study(study, arguments.resume, arguments.cluster, advance, listener)
    show(result, screen)
    screen.result(as_json(result))
    return 0


def show(result: StudyResult, screen: Screen) -> None:
    """Print a table per setting, the isolation of modes, and the path of the log."""
    single = len(result.summaries) <= 10
    for summary in result.summaries if single else ():
        screen.table(heading(summary), HEADER, [_row(score) for score in summary.scores], left=3)
        screen.say(ending(summary))
        screen.say()
    if single:
        screen.say(LEGEND)
    else:
        header = ("setting", "trials", "failures", "worst error (share of range)")
        screen.table("", header, [_short_row(summary) for summary in result.summaries])
    if result.isolation is not None:
        screen.say(isolation_in_words(result.isolation))
    per_trial = f", {1e3 * result.seconds / result.computed:.0f} ms each" if result.computed else ""
    screen.say(f"{counted(result.computed, 'trial')} in {result.seconds:.0f} s{per_trial}")
    screen.say(log_words(result.log))


HEADER = (
    *("estimator", "parameter", "unit", "bias", "RMSE", "RMSE / bound", "95 %", "RMSE / linearised", "95 %"),
    *("coverage", "95 %"),
)
LEGEND = (
    "; ".join(f"{name}: {meaning}" for name, meaning in ESTIMATORS.items())
    + "\nbias: ± 1.96 of its standard errors; bound: Cramér-Rao bound; coverage: share of trials whose stated 95 % "
    "interval contains the truth; 95 %: confidence interval of the number before it"
)


def _row(score: Score) -> list[str]:
    ratios = [text for ratio in (score.over_bound, score.over_linearised, score.coverage) for text in _shown(ratio)]
    unit, bias, error, rmse = in_display_unit(score.parameter, score.unit, score.bias, score.bias_error, score.rmse)
    size = [with_error(bias, 1.96 * error), significant(rmse, 3)]
    return [score.estimator, score.parameter.removesuffix(".size"), unit, *size, *ratios]


def _shown(ratio: Ratio | None) -> tuple[str, str]:
    return ("", "") if ratio is None else (f"{ratio.value:.3f}", f"{ratio.low:.3f} … {ratio.high:.3f}")


def heading(summary: Summary) -> str:
    return f"{summary.setting}: {summary.trials} trials, {summary.converged} converged"


def ending(summary: Summary) -> str:
    failed = ", ".join(f"{name} {count}" for name, count in summary.failures.items())
    text = (
        f"trials that ended far from the truth: {failed}; correlation of readings and model, summed over the sensors: "
    )
    text += f"{summary.rho.value:.6f}"
    if summary.undetermined:
        text += f"; {summary.undetermined} trials whose readings cannot determine every parameter"
    return text


def _short_row(summary: Summary) -> list[str]:
    name = next(iter(summary.failures))
    return [summary.setting, str(summary.trials), str(summary.failures[name]), f"{summary.worst[name]:.2g}"]


def isolation_in_words(isolation: Isolation) -> str:
    right = 100.0 * isolation.right / isolation.trials
    return (
        f"isolation: {isolation.right} of {isolation.trials} modes right ({right:.1f} %), {isolation.missed} faults "
        f"missed, {isolation.false} false ones"
    )


def as_json(result: StudyResult) -> dict[str, object]:
    return {
        "format": "fdi_torch.study/1",
        "settings": result.summaries,
        "isolation": result.isolation,
        "computed": result.computed,
        "seconds": result.seconds,
        "log": str(result.log),
    }
