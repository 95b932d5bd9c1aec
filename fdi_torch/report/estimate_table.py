"""Estimates and their correlations as rows of a table: `fdi train`, `fdi inspect` and pages show the same."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fdi_torch.report.numbers import rounded_number, shown_unit, with_error

HEADER = ("unit", "estimate", "95 % interval")
AT_95 = 1.96


def estimate_cells(name: str, si_unit: str, value: float, std: float) -> list[str]:
    """The cells below HEADER of an SI value, in its unit for display; an infinite std: it is not determined."""
    unit, scale = shown_unit(si_unit, name)
    value, std = scale * value, scale * std
    ends = (value - AT_95 * std, value + AT_95 * std)
    interval = " … ".join(rounded_number(end, std) for end in ends) if math.isfinite(std) else "–"
    return [unit or "1", with_error(value, std), interval]


def correlation_table(names: Sequence[str], covariance: np.ndarray) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the correlations (P, P) below the diagonal, of the parameters that are determined."""
    std = np.sqrt(np.diag(covariance))
    determined = np.flatnonzero(np.isfinite(std) & (std > 0.0)).tolist()
    rho = covariance[np.ix_(determined, determined)] / np.outer(std[determined], std[determined])
    numbers = [str(k + 1) for k in range(len(determined))]
    rows = [
        [f"{number}  {names[i]}", *(signed(rho[k, j]) if j <= k else "" for j in range(len(determined)))]
        for k, (number, i) in enumerate(zip(numbers, determined, strict=True))
    ]
    return ["correlation with", *numbers], rows


def signed(correlation: float) -> str:
    """A correlation with two decimals, never -0.00."""
    return f"{correlation:z.2f}".replace("-", "−")
