"""Between-run variance of a constant: its standard deviation over recordings, with a confidence interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

DETERMINED = 0.5  # share of the tolerance; a larger standard error means that the recording does not determine it


@dataclass(frozen=True)
class RunConstant:
    """A constant in one recording: source and start (s) of the recording, value and standard error in SI.

    share: of the readings in the information on it; the rest is the prior about `nominal` by its tolerance.
    """

    name: str
    source: str
    start: float
    value: float
    std: float
    nominal: float = 0.0
    share: float = 1.0

    @property
    def by_readings_alone(self) -> tuple[float, float]:
        """Value and standard error without the prior, which draws the values of all recordings towards `nominal`."""
        return self.nominal + (self.value - self.nominal) / self.share, self.std / math.sqrt(self.share)


@dataclass(frozen=True)
class BetweenRunSpread:
    """Mean, between-run standard deviation and its 95 % interval over `count` recordings."""

    count: int
    mean: float
    std: float
    low: float
    high: float


def between_run_spread(constants: Sequence[RunConstant], tolerance: float) -> BetweenRunSpread | None:
    """Between-run standard deviation s over the recordings that determine the constant; None for fewer than two.

    The values x_i by the readings alone with the standard errors e_i are normal with the variances s^2 + e_i^2, so that

        Q(s^2) = sum w_i (x_i - m)^2,   w_i = 1 / (s^2 + e_i^2),   m = sum w_i x_i / sum w_i,

    is chi-square with n - 1 degrees of freedom. At the estimate Q is n - 1 (Paule and Mandel, 1982), at the ends of the
    interval a quantile (Viechtbauer, 2007). Any of the three is 0 if Q(0) is smaller.
    """
    from scipy.optimize import brentq  # SciPy takes a while to load, and few plants have constants that vary
    from scipy.special import chdtri

    determined = [o for o in constants if o.std < DETERMINED * tolerance]
    count = len(determined)
    if count < 2:
        return None
    values, errors = torch.tensor([o.by_readings_alone for o in determined], dtype=torch.float64).unbind(1)
    scale = float(values.var())

    def weighted(variance: float) -> tuple[float, float]:
        """m and Q at s^2 = variance * scale."""
        weight = 1.0 / (variance * scale + errors**2)
        mean = (weight * values).sum() / weight.sum()
        return float(mean), float((weight * (values - mean) ** 2).sum())

    def variance_at(chi_square: float) -> float:
        if weighted(0.0)[1] <= chi_square:
            return 0.0
        return float(brentq(lambda v: weighted(v)[1] - chi_square, 0.0, 2.0 * (count - 1) / chi_square))

    high, estimate, low = (variance_at(q) for q in (chdtri(count - 1, 0.975), count - 1, chdtri(count - 1, 0.025)))
    std, low, high = (math.sqrt(v * scale) for v in (estimate, low, high))
    return BetweenRunSpread(count, weighted(estimate)[0], std, low, high)
