"""Choice of the integration step by measured error, independent of the sampling time."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from fdi_torch.simulate.engine import Engine

# Steps to try, in units of the plant's time scale.
LADDER = (20.0, 10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
PROBES = 64


def probe_points(low: Tensor, high: Tensor, count: int = PROBES) -> Tensor:
    """Points (count, P) spread evenly over a box (P,) by a scrambled Sobol sequence with a fixed seed."""
    if low.numel() == 0:
        return low.new_zeros(1, 0)
    unit = torch.quasirandom.SobolEngine(low.numel(), scramble=True, seed=0).draw(count, dtype=torch.float64)
    return low + (high - low) * unit.to(low)


def choose_step(
    engine_at: Callable[[float], Engine],
    points: Tensor,
    tolerance: Tensor,
    longest: float,
    scale: float,
    quantile: float = 1.0,
) -> float:
    """The longest step (s) of the ladder at which readings of `points` (N, P) are accurate to `tolerance` (C,).

    The error is the difference from readings with a quarter of the step; the given quantile over the points must not
    exceed the tolerance. The step is at most `longest` (s); the shortest of the ladder is returned if none suffices.
    scale: the plant's time scale, s.
    """
    ladder = [scale * rung for rung in LADDER if scale * rung <= longest] or [longest]
    for step in ladder[:-1]:
        error = (engine_at(step).readings(points) - engine_at(step / 4.0).readings(points)).abs().amax(dim=1)
        worst = torch.nan_to_num(error / tolerance, nan=torch.inf).amax(dim=1)
        if float(worst.quantile(quantile)) <= 1.0:
            return step
    return ladder[-1]
