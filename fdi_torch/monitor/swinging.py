"""Oscillations within a window: which periods its residual shows, and a phase that hardly depends on the period."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.estimate.information import Certainty

# By how much a period's central difference turns the phase at the ends of a window, in radians.
TURN = 5e-3


def swings_of(names: Sequence[str]) -> list[tuple[int, int]]:
    """The columns of period and phase of each oscillation among parameters."""
    effects = [(c, name.rpartition(".")[0]) for c, name in enumerate(names) if name.endswith(".phase")]
    return [(list(names).index(f"{effect}.period"), phase) for phase, effect in effects]


def told_at(theta: Tensor, swings: Sequence[tuple[int, int]], free: Tensor, moment: float) -> Tensor:
    """theta (L, P') with the phases at `moment` s instead of at t = 0, where they are free (L, P'); back by -moment.

    At t = 0 a phase is known to 2 pi t / T^2 times the period's error, which is many turns after a day; in the middle
    of the window that determines both, the two hardly depend on each other.
    """
    turned = theta.clone()
    for period, phase in swings:
        turn = torch.where(free[:, phase], 2.0 * math.pi * moment / theta[:, period], 0.0)
        turned[:, phase] = theta[:, phase] + turn
    return turned


def within_a_turn(theta: Tensor, swings: Sequence[tuple[int, int]], free: Tensor) -> Tensor:
    """theta (L, P') with the phases that are free (L, P') between -pi and pi."""
    turned = theta.clone()
    for _, phase in swings:
        inside = torch.remainder(theta[:, phase] + math.pi, 2.0 * math.pi) - math.pi
        turned[:, phase] = torch.where(free[:, phase], inside, theta[:, phase])
    return turned


def period_step(period: Tensor, length: float) -> Tensor:
    """A change of periods of any shape, s, that turns the phase at either end of a window of `length` s by TURN."""
    return TURN * period.square() / (math.pi * length)


def with_phase_errors(
    sure: Certainty, theta: Tensor, swings: Sequence[tuple[int, int]], free: Tensor, moment: float
) -> Tensor:
    """Standard errors (L, P') for phases at t = 0, from what is sure of those at `moment` s (delta method)."""
    std = sure.std.clone()
    for period, phase in swings:
        slope, c = 2.0 * math.pi * moment / theta[:, period].square(), sure.covariance
        variance = c[:, phase, phase] + slope**2 * c[:, period, period] + 2.0 * slope * c[:, period, phase]
        error = torch.where(torch.isfinite(variance), variance.clamp(min=0.0), torch.inf).sqrt()
        std[:, phase] = torch.where(free[:, phase], error, std[:, phase])
    return std


def strongest_periods(residual: Tensor, sampling: float, shortest: float, longest: float, count: int) -> Tensor:
    """The `count` periods (s) between two limits at which residuals (S, sensors) have most power, half a swing of the
    window apart. An observer passes a swing on at its own period, whatever it does to amplitude and phase.
    """
    length = len(residual)
    rates = torch.fft.rfftfreq(2 * length, sampling, dtype=residual.dtype)
    power = torch.fft.rfft(residual, n=2 * length, dim=0).abs().square().sum(-1)
    allowed = (rates >= 1.0 / longest) & (rates <= 1.0 / shortest)
    if not bool(allowed.any()):
        return residual.new_tensor([min(max(length * sampling, shortest), longest)])
    rates, power = rates[allowed], power[allowed]
    return 1.0 / rates[power.topk(min(count, len(power))).indices]
