"""Confidence interval of a binomial proportion."""

from __future__ import annotations

from statistics import NormalDist


def wilson(count: int, trials: int) -> tuple[float, float]:
    """95 % score interval of the proportion count / trials (Wilson 1927); (0, 1) without trials."""
    if not trials:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.975)
    proportion, z2_over_n = count / trials, z * z / trials
    middle = (proportion + 0.5 * z2_over_n) / (1.0 + z2_over_n)
    half_width = z * (proportion * (1.0 - proportion) / trials + 0.25 * z * z / trials**2) ** 0.5 / (1.0 + z2_over_n)
    return middle - half_width, middle + half_width
