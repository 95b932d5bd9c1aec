"""Between-run variance of a constant: its standard deviation over recordings, with a confidence interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

DETERMINED = 0.5  # share of the tolerance; a larger standard error means that the recording does not determine it


@dataclass(frozen=True)
class RunConstant:
    """A constant in one recording: source and start (s) of the recording, value and standard error in SI."""

    name: str
    source: str
    start: float
    value: float
    std: float


@dataclass(frozen=True)
class BetweenRunSpread:
    """Mean, standard deviation and its 95 % interval over `count` recordings."""

    count: int
    mean: float
    std: float
    low: float
    high: float


def between_run_spread(constants: Sequence[RunConstant], tolerance: float) -> BetweenRunSpread | None:
    """Standard deviation over the recordings that determine the constant; None for fewer than two.

    For independent normal values, (n - 1) s^2 / sigma^2 is chi-square with n - 1 degrees of freedom.
    """
    from scipy.special import chdtri  # SciPy takes a while to load, and few plants have constants that vary

    values = torch.tensor([o.value for o in constants if o.std < DETERMINED * tolerance], dtype=torch.float64)
    count = len(values)
    if count < 2:
        return None
    std = float(values.std())
    low, high = (std * math.sqrt((count - 1) / chdtri(count - 1, share)) for share in (0.025, 0.975))
    return BetweenRunSpread(count, float(values.mean()), std, low, high)
