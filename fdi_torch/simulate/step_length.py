"""Choice of the integration step by measured error, independent of the sampling time."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.simulate.engine import Engine

# The shortest and the longest step to try, in units of the plant's time scale.
SHORTEST, LONGEST = 0.015, 30.0
PROBES = 64
# A step that follows from the plant's constants may be longer by this share. Usual sampling intervals are multiples of
# usual steps, and remain so after the constants are estimated again.
TOLERATED = 0.05
ROUNDING = 1e-9


def commensurate_step(step: float, interval: float) -> float:
    """The longest whole fraction, or whole multiple, of a sampling interval (s) that is at most about `step`, s."""
    longest = (1.0 + TOLERATED) * step
    if longest < interval:
        return interval / math.ceil(interval / longest - ROUNDING)
    return interval * math.floor(longest / interval + ROUNDING)


def step_ladder(interval: float, scale: float, longest: float) -> list[float]:
    """Steps to try, descending, s: 1, 2, 5, 10 ... times a sampling interval, or that fraction of it.

    scale: the plant's time scale, s. longest: the longest step, s, which is the only one if all others are longer.
    """
    lowest, highest = SHORTEST * scale, min(longest, LONGEST * scale)
    decades = range(math.floor(math.log10(lowest / interval)), math.ceil(math.log10(highest / interval)) + 1)
    steps = [interval * digit * 10.0**decade for decade in decades for digit in (1, 2, 5)]
    return [step for step in reversed(steps) if lowest <= step <= highest * (1.0 + ROUNDING)] or [longest]


def probe_points(low: Float[Tensor, " P"], high: Float[Tensor, " P"], count: int = PROBES) -> Float[Tensor, "N P"]:
    """Points (count, P) spread evenly over a box (P,) by a scrambled Sobol sequence with a fixed seed."""
    if low.numel() == 0:
        return low.new_zeros(1, 0)
    unit = torch.quasirandom.SobolEngine(low.numel(), scramble=True, seed=0).draw(count, dtype=torch.float64)
    return low + (high - low) * unit.to(low)


def choose_step(
    engine_at: Callable[[float], Engine],
    points: Float[Tensor, "N P"],
    tolerance: Float[Tensor, " C"],
    ladder: list[float],
    quantile: float = 1.0,
) -> float:
    """The longest step (s) of a ladder at which readings of `points` (N, P) are accurate to `tolerance` (C,).

    The error is the difference from readings with a quarter of the step; the given quantile over the points must not
    exceed the tolerance. The shortest step of the ladder is returned if none suffices.
    """
    for step in ladder[:-1]:
        error = (engine_at(step).readings(points) - engine_at(step / 4.0).readings(points)).abs().amax(dim=1)
        worst = torch.nan_to_num(error / tolerance, nan=torch.inf).amax(dim=1)
        if float(worst.quantile(quantile)) <= 1.0:
            return step
    return ladder[-1]
