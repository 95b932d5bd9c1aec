"""Confidence intervals for shares, means and medians."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any

from scipy import special


def clopper_pearson(k: int, n: int) -> tuple[float, float]:
    """Exact 95 % interval for a share of k in n (Clopper and Pearson, 1934); (0, 1) for n = 0."""
    if n == 0:
        return 0.0, 1.0
    low = special.betaincinv(k, n - k + 1, 0.025) if k else 0.0
    return float(low), float(special.betaincinv(k + 1, n - k, 0.975)) if k < n else 1.0


def share_of(hits: int, count: int) -> dict[str, Any]:
    """A share with its exact 95 % interval, as in the tables of scores."""
    return {"of": count, "hits": hits, "share": hits / count, "ci95": clopper_pearson(hits, count)}


def median_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Median and the order statistics of its distribution-free 95 % interval; NaN for few values."""
    ranked, n = sorted(values), len(values)
    if not ranked:
        return math.nan, math.nan, math.nan
    outside = [k for k in range(1, n // 2 + 1) if special.bdtr(k - 1, n, 0.5) <= 0.025]
    low, high = (ranked[outside[-1] - 1], ranked[n - outside[-1]]) if outside else (math.nan, math.nan)
    return statistics.median(ranked), low, high


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean and its normal 95 % interval; NaN without values, and its ends for one value."""
    if not values:
        return math.nan, math.nan, math.nan
    mean = statistics.fmean(values)
    half = 1.96 * statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return mean, mean - half, mean + half


def root_mean_square_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Root mean square of normal values of mean 0, and its 95 % interval by chi-square."""
    n = len(values)
    if n == 0:
        return math.nan, math.nan, math.nan
    square = math.fsum(v * v for v in values)
    low, high = (math.sqrt(square / float(special.chdtri(n, p))) for p in (0.025, 0.975))
    return math.sqrt(square / n), low, high
