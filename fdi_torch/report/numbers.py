"""Numbers and units on pages, numbers out of a log's JSON, which may hold anything, and the rows of estimates and
correlations that `fdi train`, `fdi inspect` and pages show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdi_torch.amounts import RAISED, interval_words, rounded, with_error
from fdi_torch.clock import clock_unit
from fdi_torch.estimate.combinations import Combination
from fdi_torch.parameters import ParameterName
from fdi_torch.quantities import display_unit, significant
from fdi_torch.report.html import typeset
from fdi_torch.tables import Table, in_display_unit


def shown_unit(si_unit: str, name: str = "") -> tuple[str, float]:
    """'m^3/s' -> ('cm³/s', 1e6): `display_unit` as text in a figure."""
    unit, scale = display_unit(si_unit, name)
    return typeset(unit), scale


def axis(name: str, unit: str) -> str:
    """'level, cm': label of an axis."""
    return f"{name}, {typeset(unit)}" if unit else name


def number(value: float, digits: int = 4) -> str:
    """A number with the given significant digits, '2·10⁻⁵' where it needs an exponent; a dash for NaN."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "-∞")
    factor, _, exponent = significant(value, digits).partition("e")
    return factor + (f"·10{str(int(exponent)).translate(RAISED)}" if exponent else "")


def percent(share: float) -> str:
    return f"{100.0 * share:.3g} %" if math.isfinite(share) else "–"


def as_float(value: Any) -> float:
    """A number of a log; NaN for anything else."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def as_vector(values: Any) -> np.ndarray:
    return np.array([as_float(value) for value in values])


NONE: Mapping[str, Any] = {}
UNLIMITED = (-math.inf, math.inf)
HEADER = ("unit", "estimate", "95 % interval")


def estimate_cells(
    name: str, si_unit: str, value: Any, std: Any, end: str = "", limits: tuple[float, float] = UNLIMITED
) -> list[str]:
    """The cells below HEADER of an SI value, in its unit for display; without a finite std it is not determined. end:
    'low' or 'high' for an estimate at an end of its range, the SI `limits`; see `amounts.interval_words`.
    """
    numbers = (math.nan if value is None else float(value), math.inf if std is None else float(std))
    unit, value, std, low, high = in_display_unit(name, si_unit, *numbers, *limits)
    known = math.isfinite(value) and math.isfinite(std)
    unit = clock_unit(unit, ParameterName.parse(name).field, numbers[0]) if known else unit
    estimate = rounded(value, std) if end and known and std > 0.0 else with_error(value, std)
    return [unit, estimate, interval_words(value, std, low, high, end)]


def estimate_table(
    title: str,
    names: Any,
    units: Any,
    values: Any,
    std: Any,
    *,
    ends: Mapping[str, str] = NONE,
    ranges: Mapping[str, tuple[float, float]] = NONE,
    combinations: Sequence[Combination] = (),
    exact: Mapping[str, Mapping[str, float]] = NONE,
) -> Table:
    """The estimates (P,) of parameters, SI, then their determined combinations.

    ends: 'low' or 'high' by the name of a parameter. ranges: their lowest and highest values, SI. exact: further
    columns by their title, with exact values by parameter, SI.
    """
    columns = zip(names, units, values, std, strict=True)
    listed: list[Any] = [
        (n, (n,), (1.0,), str(unit), value, s, ends.get(n, ""), ranges.get(n, UNLIMITED))
        for n, unit, value, s in columns
    ]
    listed += [(c.formula, c.parameters, c.coefficients, c.unit, c.value, c.std) for c in combinations]
    rows = []
    for name, parameters, coefficients, unit, *numbers in listed:
        row = [name, *estimate_cells(parameters[0], unit, *numbers)]
        for known in exact.values():
            pairs = zip(coefficients, parameters, strict=True)
            _, value = in_display_unit(parameters[0], unit, sum(c * known.get(p, math.nan) for c, p in pairs))
            row.append(number(value, 5) if math.isfinite(value) else "")
        rows.append(row)
    return Table(("parameter", *HEADER, *exact), rows, title)


def correlation_table(names: Sequence[str], covariance: np.ndarray) -> Table:
    """The correlations (P, P) below the diagonal, of the parameters that are determined."""
    std = np.sqrt(np.diag(covariance))
    determined = np.flatnonzero(np.isfinite(std) & (std > 0.0)).tolist()
    rho = covariance[np.ix_(determined, determined)] / np.outer(std[determined], std[determined])
    numbers = [str(k + 1) for k in range(len(determined))]
    rows = [
        [f"{number}  {names[i]}", *(signed(rho[k, j]) if j <= k else "" for j in range(len(determined)))]
        for k, (number, i) in enumerate(zip(numbers, determined, strict=True))
    ]
    return Table(["correlation with", *numbers], rows, "correlations of the estimates", words=1)


def signed(correlation: float) -> str:
    """A correlation with two decimals, never -0.00."""
    return f"{correlation:z.2f}"
