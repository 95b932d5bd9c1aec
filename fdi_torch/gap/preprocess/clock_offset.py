"""Clock offsets y(t) = y'(t + delay): of all sensors against the inputs, or of one sensor against the others."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.gap.preprocess.blockwise_likelihood import BlockwiseFit
from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, Correction
from fdi_torch.gap.preprocess.recording_fault_texts import clock_offset
from fdi_torch.recording import Recording
from fdi_torch.simulate.resampling import interpolate

MAX_DELAY = 0.25
"""Largest clock offset, as a share of the recording."""
DELAY_CORRECTIONS = 4
"""Gauss-Newton steps for the clock offset."""
DELAY_TOLERANCE = 0.05
"""Share of a sampling interval; a smaller correction of the clock offset ends the iteration."""


def clock_offsets(fits: CorrectedFits) -> Iterator[list[Correction]]:
    """Clock offsets of all sensors together and of each sensor alone."""
    sensors = range(len(fits.plant.sensors))
    for late in [list(sensors), *([i] for i in sensors if len(sensors) > 1)]:
        if delay := _initial_delay(fits.as_is, late):
            yield [_correction(fits, late, delay, DELAY_CORRECTIONS)]


def _correction(fits: CorrectedFits, late: list[int], delay: float, steps: int) -> Correction:
    """A clock offset of `delay` s. steps: Gauss-Newton steps for the delay that are left."""

    def refined(fit: BlockwiseFit) -> Correction | None:
        further = _remaining_delay(fit, late)
        small = abs(further) < DELAY_TOLERANCE * fits.as_is.blocked.recording.interval
        return None if small or not steps else _correction(fits, late, delay + further, steps - 1)

    columns = tuple(fits.plant.sensors[i].column for i in late)
    fault = clock_offset(columns, delay, len(late) == len(fits.plant.sensors))
    cost = 0.5 * math.log(float(fits.as_is.means.sum()))
    return Correction(fault, _shifted(fits, late, delay), cost, refined=refined)


def _shifted(fits: CorrectedFits, late: list[int], delay: float) -> Recording:
    """The recording with some sensors' readings `delay` seconds earlier; unknown readings are masked."""
    r = fits.recording
    outputs, mask = r.outputs.clone(), r.mask.clone()
    for column in map(fits.column, late):
        valid = mask[:, column].clone()
        times = r.time[valid]
        at = r.time + delay
        if len(times):
            outputs[:, column] = interpolate(at, times, r.outputs[valid, column])
            mask[:, column] &= (at >= times[0]) & (at <= times[-1])
    return replace(r, outputs=outputs, mask=mask)


def _initial_delay(as_is: BlockwiseFit, late: list[int]) -> float:
    """The likeliest delay (s) in whole samples of the thinned recording, at the constants of the uncorrected fit."""
    blocked, model = as_is.blocked, as_is.readings[:, late]
    most = int(MAX_DELAY * len(model))
    mean_square = _mean_square(blocked.data.readings[:, late], model, blocked.data.mask[:, late], most)
    log_likelihood = -0.5 * (torch.log(mean_square + blocked.noise[late]) @ as_is.means[late])
    return (int(log_likelihood.argmax()) - most) * blocked.recording.interval


def _mean_square(readings: Tensor, model: Tensor, mask: Tensor, most: int) -> Tensor:
    """Mean square of readings[k + lag] - model[k] over the valid readings, for lags of -most to most samples.

    readings, model, mask (S, C) -> (2 most + 1, C), by fast Fourier transforms.
    """
    center = torch.where(mask, readings, 0.0).sum(dim=0) / mask.sum(dim=0).clamp(min=1)
    x, m, keep = torch.where(mask, readings - center, 0.0), model - center, mask.to(readings.dtype)
    size = 2 * len(m)

    def correlation(a: Tensor, b: Tensor) -> Tensor:
        whole = torch.fft.irfft(torch.fft.rfft(a, size, dim=0) * torch.fft.rfft(b, size, dim=0).conj(), size, dim=0)
        return torch.cat([whole[size - most :], whole[: most + 1]])

    one = torch.ones_like(m)
    square = correlation(x**2, one) - 2.0 * correlation(x, m) + correlation(keep, m**2)
    return square.clamp(min=0.0) / correlation(keep, one).clamp(min=1.0)


def _remaining_delay(fit: BlockwiseFit, late: list[int]) -> float:
    """The delay (s) that remains in these sensors' readings: least squares for r = -delay dm/dt, weighted by 1/v_c."""
    blocked, model = fit.blocked, fit.readings[:, late]
    slope = torch.gradient(model, spacing=(blocked.recording.time,), dim=0)[0]
    mask, weight = blocked.data.mask[:, late], 1.0 / fit.variance[late]
    residual = torch.where(mask, blocked.data.readings[:, late] - model, 0.0)
    slope = torch.where(mask, slope, 0.0)
    return -float((residual * slope * weight).sum() / (slope * slope * weight).sum().clamp(min=1e-300))
