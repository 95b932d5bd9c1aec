"""Oscillation faults within a window: candidate periods from the residual's spectrum, and phase conventions.

A fit uses the phase in the middle of the window, where it hardly depends on the period T. The parameters of an
oscillation contain the phase at t = 0. Its standard deviation is 2 pi t / T^2 times that of the period for a window at
time t, which is many turns after a day.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.parameters import ParameterName

# Phase change, in radians at the ends of a window, of the finite-difference step of a period.
PHASE_STEP = 5e-3


def oscillation_columns(names: Sequence[str]) -> list[tuple[int, int]]:
    """The columns (period, phase) of each oscillation among parameters."""
    phases = [(c, name) for c, name in enumerate(map(ParameterName.parse, names)) if name.field == "phase"]
    return [(list(names).index(str(name.sibling("period"))), phase) for phase, name in phases]


def with_phases_at(theta: Tensor, oscillations: Sequence[tuple[int, int]], free: Tensor, time: float) -> Tensor:
    """theta (L, P') with its free (L, P') phases, given at t = 0, converted to `time` s; -time converts them back."""
    converted = theta.clone()
    for period, phase in oscillations:
        turn = torch.where(free[:, phase], 2.0 * math.pi * time / theta[:, period], 0.0)
        converted[:, phase] = theta[:, phase] + turn
    return converted


def with_wrapped_phases(theta: Tensor, oscillations: Sequence[tuple[int, int]], free: Tensor) -> Tensor:
    """theta (L, P') with its free (L, P') phases between -pi and pi."""
    wrapped = theta.clone()
    for _, phase in oscillations:
        inside = torch.remainder(theta[:, phase] + math.pi, 2.0 * math.pi) - math.pi
        wrapped[:, phase] = torch.where(free[:, phase], inside, theta[:, phase])
    return wrapped


def period_step(period: Tensor, length: float) -> Tensor:
    """Finite-difference step of periods, s: it turns the phase by PHASE_STEP at the ends of a window of `length` s."""
    return PHASE_STEP * period.square() / (math.pi * length)


def std_with_phases_at_zero(
    c: Tensor, theta: Tensor, oscillations: Sequence[tuple[int, int]], free: Tensor, time: float
) -> Tensor:
    """Standard deviations (L, P') for phases at t = 0, from the covariance c (L, P', P') for phases at `time` s (delta
    method)."""
    std = c.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
    for period, phase in oscillations:
        slope = 2.0 * math.pi * time / theta[:, period].square()
        variance = c[:, phase, phase] + slope**2 * c[:, period, period] + 2.0 * slope * c[:, period, phase]
        error = torch.where(torch.isfinite(variance), variance.clamp(min=0.0), torch.inf).sqrt()
        std[:, phase] = torch.where(free[:, phase], error, std[:, phase])
    return std


def strongest_periods(residual: Tensor, sampling: float, shortest: float, longest: float, count: int) -> Tensor:
    """The `count` periods (s) between two limits at which residuals (S, sensors) have the most power.

    The frequency grid has half the window's resolution as its step. An observer changes amplitude and phase of an
    oscillation but not its period, so the residual shows the period of the fault.
    """
    length = len(residual)
    frequencies = torch.fft.rfftfreq(2 * length, sampling, dtype=residual.dtype)
    power = torch.fft.rfft(residual, n=2 * length, dim=0).abs().square().sum(-1)
    allowed = (frequencies >= 1.0 / longest) & (frequencies <= 1.0 / shortest)
    if not bool(allowed.any()):
        return residual.new_tensor([min(max(length * sampling, shortest), longest)])
    frequencies, power = frequencies[allowed], power[allowed]
    return 1.0 / frequencies[power.topk(min(count, len(power))).indices]
