"""Detectors on white residuals: fixed threshold and CUSUM, designed for a mean time between false alarms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.monitor.false_alarm_rate import (
    ChartRate,
    FalseAlarmDesign,
    cusum_rate,
    fixed_rate,
    latin_hypercube,
)
from fdi_torch.monitor.whitening import Whitening

Chart = Literal["fixed", "cusum"]
CHARTS: tuple[Chart, ...] = ("fixed", "cusum")

# CUSUM's drift: half the shift, in standard deviations of the white residual, for which the detection delay is least.
DRIFT = 0.5
NO_ALARM = -1


@dataclass(frozen=True)
class Detector:
    """A statistic of white residuals, and its threshold.

    design: of the threshold. update: (samples (*batch, S, C), memory or None at the start) -> (statistic (*batch, S),
    memory). Its result is identical to the last bit for any division of the samples into calls.
    """

    chart: str
    design: FalseAlarmDesign
    update: Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]

    @property
    def threshold(self) -> float:
        return self.design.threshold

    def shares(self, white: Tensor) -> Tensor:
        """Share (C,) of each channel in the statistic at the last sample of white residuals (S, C)."""
        single = torch.eye(white.shape[-1], dtype=torch.bool).unsqueeze(1)
        each = self.update(torch.where(single, white, 0.0), None)[0][:, -1]
        return each / each.sum().clamp(min=1e-300)

    def first_alarm(self, white: Tensor) -> Tensor:
        """Index of the first sample above the threshold, (*batch); NO_ALARM if there is none."""
        above = self.update(white, None)[0] > self.threshold
        first = above.to(torch.int8).argmax(dim=-1)
        return torch.where(above.any(dim=-1), first, torch.full_like(first, NO_ALARM))

    def alarms(self, white: Tensor) -> Tensor:
        """(*batch, S), True where an alarm is raised. After each, the detector restarts with the next sample."""
        remaining = torch.nan_to_num(white, nan=0.0)
        index = torch.arange(remaining.shape[-2], device=remaining.device)
        alarms = torch.zeros(remaining.shape[:-1], dtype=torch.bool, device=remaining.device)
        while True:
            first = self.first_alarm(remaining).unsqueeze(-1)
            if not bool((first != NO_ALARM).any()):
                return alarms
            alarms = alarms | (index == first)
            remaining = torch.where((index <= first).unsqueeze(-1), torch.zeros_like(remaining), remaining)


def make_detector(
    chart: Chart,
    time_between_false_alarms: float,
    sampling: float,
    channels: int,
    generator: torch.Generator,
    learnt: Whitening | None = None,
) -> Detector:
    """A detector with the given mean time between false alarms (s) over all channels together.

    sampling: s between samples. learnt: whitening estimated from a finite recording, whose uncertainty raises the
    threshold; without it the noise is known. Raises ValueError.
    """
    run_length = time_between_false_alarms / sampling
    if not run_length >= 20.0:
        raise ValueError(
            f"expected a mean time between false alarms of at least 20 samples, got {run_length:g} samples; "
            "ask for fewer false alarms"
        )
    rate: ChartRate
    update: Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]
    length: Callable[[float], int]  # of the sums that decide about an alarm
    if chart == "fixed":
        rate, length, update = fixed_rate, lambda threshold: 1, max_abs
    elif chart == "cusum":
        # A sum that alarms by chance has most likely grown by the drift with each sample.
        rate, length = partial(cusum_rate, drift=DRIFT), lambda threshold: max(round(threshold / DRIFT), 1)
        update = partial(cusum, DRIFT)
    else:
        raise ValueError(f"expected a detector of {', '.join(CHARTS)}, got '{chart}'")

    def error(threshold: float) -> Tensor:
        if learnt is None:
            return torch.zeros(channels, dtype=torch.float64)
        return learnt.error_of_sums(length(threshold))

    median = torch.full((1, channels), 0.5, dtype=torch.float64)
    share = median if learnt is None else latin_hypercube(channels, generator)
    return Detector(chart, FalseAlarmDesign(rate, error, share, run_length, sampling), update)


def max_abs(white: Tensor, before: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """max over channels of |e|, for white (*batch, S, C). It has no memory."""
    return torch.nan_to_num(white, nan=0.0).abs().amax(dim=-1), white[..., :0, :]


def cusum(drift: float, white: Tensor, before: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The largest of 2 C one-sided sums g = max(0, g +- e - drift) (Page 1954), as a sum minus its running minimum.

    A missing reading leaves its sums unchanged; otherwise the drift would reset the sums of a rarely read sensor. white
    (*batch, S, C); before (*batch, 2, 2 C): the sums and their minima after the previous sample.
    """
    moves = torch.nan_to_num(torch.cat([white, -white], dim=-1) - drift, nan=0.0)
    before = moves.new_zeros(*moves.shape[:-2], 2, moves.shape[-1]) if before is None else before
    sums = torch.cumsum(torch.cat([before[..., :1, :], moves], dim=-2), dim=-2)[..., 1:, :]
    lowest = torch.cummin(torch.cat([before[..., 1:, :], sums], dim=-2), dim=-2).values[..., 1:, :]
    return (sums - lowest).amax(dim=-1), torch.stack([sums[..., -1, :], lowest[..., -1, :]], dim=-2)
