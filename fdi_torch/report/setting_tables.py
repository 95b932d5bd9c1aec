"""The scores of a study's settings as tables, from the numbers that its log has, for terminal and page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from fdi_torch.amounts import parameter_words, with_error
from fdi_torch.names import listed
from fdi_torch.quantities import quantity_text
from fdi_torch.report.numbers import as_float, number
from fdi_torch.study.estimators import ESTIMATORS
from fdi_torch.tables import Table, in_display_unit

MOST_SETTINGS = 10  # of more, the tables are one with a row for each
RATIOS = {"over_bound": "RMSE / bound", "over_linearised": "RMSE / linearised", "coverage": "coverage"}
LEGEND = (
    "; ".join(f"{name}: {meaning}" for name, meaning in ESTIMATORS.items())
    + "\nbias: ± 1.96 of its standard errors; RMSE: root mean square error; bound: Cramér-Rao bound, the smallest RMSE "
    "of an unbiased estimator with this noise (at 1, no such estimator is better; below 1, bounds on the parameters or "
    "another bias keep the errors small); coverage: share of trials whose stated 95 % interval contains the truth; "
    "95 %: confidence interval of the number before it"
)
Numbers = Mapping[str, Any]
"""The numbers of a setting by their dotted names, `Summary.numbers`."""


def setting_tables(
    settings: Sequence[tuple[str, Any, Numbers]], units: Mapping[str, str], brief: bool = False
) -> list[Table]:
    """The scores of settings, given as name, number of trials and numbers; of many, one table with their failures.

    units: SI units by parameter, and by sensor if the numbers have their noise. brief: of each estimator but the first,
    only the parameter with the largest error relative to the bound.
    """
    if len(settings) <= MOST_SETTINGS:
        return [_setting_table(*setting, units, brief) for setting in settings]
    rows = []
    for setting, trials, numbers in settings:
        name = next((name for name in ESTIMATORS if f"{name}.failures" in numbers), "")
        failures, worst = (as_float(numbers.get(f"{name}.{key}")) for key in ("failures", "worst"))
        rows.append((setting, trials, number(failures), number(worst, 2)))
    return [Table(("setting", "trials", "failures", "worst error (share of range)"), rows)]


def isolation_sentence(counts: Mapping[str, Any]) -> str:
    """How many modes were stated correctly, from the counts of an `Isolation`."""
    right, trials, missed, false = (counts.get(name, "?") for name in ("right", "trials", "missed", "false"))
    return f"{right} of {trials} modes stated correctly; {missed} faults missed, {false} false faults."


def _setting_table(setting: str, trials: Any, numbers: Numbers, units: Mapping[str, str], brief: bool = False) -> Table:
    """One row per estimator and parameter; brief: as of `setting_tables`. The summary says how the trials ended."""
    rows = []
    scores = [key.removesuffix(".rmse") for key in numbers if key.endswith(".rmse")]
    for score in _first_and_worst(scores, numbers) if brief else scores:
        estimator, _, parameter = score.partition(".")
        errors = (as_float(numbers.get(f"{score}.{key}")) for key in ("bias", "bias_error", "rmse"))
        unit, bias, error, rmse = in_display_unit(parameter, units[parameter], *errors)
        ratios: list[str] = []
        for name in (f"{score}.{ratio}" for ratio in RATIOS):
            value, low, high = (as_float(numbers.get(key)) for key in (name, f"{name}.low", f"{name}.high"))
            ratios += [f"{value:.3f}", f"{low:.3f} … {high:.3f}"] if value == value else ["", ""]
        sizes = (with_error(bias, 1.96 * error), number(rmse, 3))
        rows.append((estimator, parameter.removesuffix(".size"), unit, *sizes, *ratios))
    header = ["estimator", "parameter", "unit", "bias", "RMSE"]
    header += [cell for name in RATIOS.values() for cell in (name, "95 %")]
    title = f"{setting}: {trials} trials, {number(as_float(numbers.get('converged')))} converged"
    return Table(header, rows, title, summary="; ".join(filter(None, [*_accuracies(numbers, units), _ending(numbers)])))


def _first_and_worst(scores: Sequence[str], numbers: Numbers) -> list[str]:
    """The scores of the first estimator, and of each other one that with the largest error relative to the bound."""
    by_estimator: dict[str, list[str]] = {}
    for score in scores:
        by_estimator.setdefault(score.partition(".")[0], []).append(score)
    first, *others = by_estimator.values() or [[]]

    def error(score: str) -> float:
        ratio = as_float(numbers.get(f"{score}.over_bound"))
        return ratio if math.isfinite(ratio) else -1.0

    return [*first, *(max(each, key=error) for each in others)]


def _accuracies(numbers: Numbers, units: Mapping[str, str]) -> list[str]:
    """'with noise of 0.4 mm at h1, free estimates leak at T1 (true value 0.2) to ± 0.003'; of the first estimator."""
    noise = [
        f"{quantity_text(as_float(std), units[sensor], 3, sensor)} at {sensor}"
        for sensor, std in (
            (key.removeprefix("noise."), std) for key, std in numbers.items() if key.startswith("noise.")
        )
        if sensor in units
    ]
    estimator = next((name for name in ESTIMATORS if f"{name}.failures" in numbers), "")
    errors = []
    for parameter, unit in units.items():
        rmse = as_float(numbers.get(f"{estimator}.{parameter}.rmse"))
        if math.isfinite(rmse):
            truth = numbers.get(f"truth.{parameter}")
            of = "" if truth is None else f" (true value {quantity_text(as_float(truth), unit, name=parameter)})"
            errors.append(f"{parameter_words(parameter)}{of} to ± {quantity_text(rmse, unit, 2, parameter)}")
    return [f"with noise of {listed(noise)}, {estimator} estimates {listed(errors)}"] if noise and errors else []


def _ending(numbers: Numbers) -> str:
    failed = [f"{name} {numbers[f'{name}.failures']}" for name in ESTIMATORS if f"{name}.failures" in numbers]
    parts = [f"trials that ended far from the truth: {', '.join(failed)}"] if failed else []
    if "rho" in numbers:
        parts.append(f"correlation of readings and model, summed over the sensors: {as_float(numbers['rho']):.6f}")
    if numbers.get("undetermined"):
        parts.append(f"{numbers['undetermined']} trials whose readings cannot determine every parameter")
    return "; ".join(parts)
