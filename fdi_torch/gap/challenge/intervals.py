"""Intervals for shares and means."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence


def binomial_tail(k: int, n: int, p: float) -> float:
    """P(X >= k) for X binomial (n, p)."""
    if k <= 0:
        return 1.0
    if p <= 0 or p >= 1:
        return float(p >= 1)
    log_choose = [math.lgamma(n + 1) - math.lgamma(i + 1) - math.lgamma(n - i + 1) for i in range(k, n + 1)]
    terms = [c + i * math.log(p) + (n - i) * math.log1p(-p) for i, c in zip(range(k, n + 1), log_choose, strict=True)]
    return min(1.0, math.fsum(math.exp(t) for t in terms))


def clopper_pearson(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval for a share of k in n (Clopper and Pearson, 1934); (0, 1) for n = 0."""
    tail = (1 - confidence) / 2
    low = 0.0 if k == 0 else _root(lambda p: binomial_tail(k, n, p) - tail)
    high = 1.0 if k == n else _root(lambda p: binomial_tail(k + 1, n, p) - (1 - tail))
    return low, high


def median_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Median and the order statistics that hold it in 95 % of samples of any distribution; NaN where there are few."""
    ranked, n = sorted(values), len(values)
    if not ranked:
        return math.nan, math.nan, math.nan
    median = 0.5 * (ranked[(n - 1) // 2] + ranked[n // 2])
    outside = [k for k in range(1, n // 2 + 1) if 1 - binomial_tail(k, n, 0.5) <= 0.025]
    if not outside:
        return median, math.nan, math.nan
    return median, ranked[outside[-1] - 1], ranked[n - outside[-1]]


def _root(rising: Callable[[float], float]) -> float:
    """Where a function that rises on [0, 1] passes zero, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if rising(middle) > 0 else (middle, high)
    return 0.5 * (low + high)


def mean_interval(values: Sequence[float], z: float = 1.96) -> tuple[float, float, float]:
    """Mean and its normal 95 % interval; NaN where there are no values, no width where there is one."""
    if not values:
        return math.nan, math.nan, math.nan
    mean = math.fsum(values) / len(values)
    if len(values) == 1:
        return mean, math.nan, math.nan
    std = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1))
    half = z * std / math.sqrt(len(values))
    return mean, mean - half, mean + half
