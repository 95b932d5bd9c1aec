"""How sure a share is that was counted."""

from __future__ import annotations

from statistics import NormalDist


def wilson(count: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """The interval of the share count / trials (Wilson 1927); from 0 to 1 where nothing was tried."""
    if not trials:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + 0.5 * confidence)
    share, spread = count / trials, z * z / trials
    middle = (share + 0.5 * spread) / (1.0 + spread)
    half = z * (share * (1.0 - share) / trials + 0.25 * z * z / trials**2) ** 0.5 / (1.0 + spread)
    return middle - half, middle + half
