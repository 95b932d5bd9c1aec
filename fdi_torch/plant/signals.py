"""Time inside a simulation: the clock of one step, and exact means of sampled signals over a step."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from fdi_torch.recording import Hold

SAME_INSTANT = 1e-9  # s; closer than this, two instants differ by rounding only


@dataclass(frozen=True)
class Clock:
    """Integration steps, or sampling intervals, [start, start + step] in s.

    resolution: the shortest time that the integrator resolves, s, one for all steps or one for each; it sets the
    smoothing of square roots and rims.
    explicit: whether the steps are stable only for rates of change below about 2 / resolution.
    """

    start: torch.Tensor
    step: torch.Tensor
    resolution: torch.Tensor
    explicit: bool = True

    @property
    def middle(self) -> torch.Tensor:
        return self.start + 0.5 * self.step

    @property
    def end(self) -> torch.Tensor:
        return self.start + self.step

    def part(self, steps: slice) -> Clock:
        """The clock of some of the steps (K,)."""
        return replace(
            self,
            start=self.start[steps],
            step=self.step[steps],
            resolution=self.resolution.expand_as(self.step)[steps],
        )

    def share_after(self, instant: torch.Tensor) -> torch.Tensor:
        """Share of the step after `instant`: the exact mean over the step of a switch at that instant."""
        return torch.clamp(_since((self.end - instant) / self.step), max=1.0)

    def risen(self, onset: torch.Tensor, ramp: torch.Tensor) -> torch.Tensor:
        """Exact mean over the step of a linear rise from 0 to 1 that begins at `onset` (s) and takes `ramp` (s)."""
        end, start = _since(self.end - onset), _since(self.start - onset)
        return self.share_after(onset) - (_lag_integral(end, ramp) - _lag_integral(start, ramp)) / self.step

    def risen_by_end(self, onset: torch.Tensor, ramp: torch.Tensor) -> torch.Tensor:
        """The rise from 0 to 1 as a sample at the step's end shows it, smoothed over one sampling interval.

        A sample at or after the onset of an abrupt rise shows it in full; an onset of 0 therefore acts from the start.
        """
        return torch.clamp((self.end - onset + self.step) / (torch.clamp(ramp, min=0.0) + self.step), 0.0, 1.0)

    def decay(self, time_constant: torch.Tensor) -> torch.Tensor:
        """exp(-step / time constant); exactly 0, with zero slope, for time constants far below the step."""
        ratio = torch.clamp(time_constant / self.step, min=1e-3)
        return torch.exp(-1.0 / ratio)

    def sine(self, period: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
        """Mean of sin(2 pi t / period + phase) over the step."""
        half = math.pi * self.step / period
        return torch.sin(2.0 * math.pi * self.middle / period + phase) * torch.sin(half) / half


def _since(time: torch.Tensor) -> torch.Tensor:
    """max(time, 0) with slope 0 at 0: the shift of an instant between two steps counts in the later one only."""
    return torch.where(time <= 0.0, 0.0, time)


def _lag_integral(since: torch.Tensor, ramp: torch.Tensor) -> torch.Tensor:
    """Integral of what a linear rise within `ramp` (s) lacks of 1, from its onset to `since` seconds after it, s."""
    rising = torch.minimum(since, ramp)
    return rising - 0.5 * rising * (rising / torch.clamp(ramp, min=1e-9))


class CumulativeSignal:
    """The integral of each input channel, which gives its exact mean over any interval, delayed or not.

    time (T,) s, values (T, C). A zero-order-hold signal is integrated exactly between any two instants; a linear one
    between its samples. The signal is constant before the first and after the last sample.
    """

    def __init__(self, time: torch.Tensor, values: torch.Tensor, hold: Hold) -> None:
        self.time = time
        mean = values[:-1] if hold == "zero_order" else 0.5 * (values[:-1] + values[1:])
        self.slopes = torch.cat([values[:1], mean, values[-1:]])  # slope of the integral before, between, after samples
        steps = torch.diff(time).unsqueeze(1)
        self.integral = torch.cat([torch.zeros_like(values[:1]), torch.cumsum(mean * steps, dim=0)])

    @property
    def channels(self) -> int:
        return self.integral.shape[1]

    def up_to(self, instant: torch.Tensor, channel: int) -> torch.Tensor:
        """The integral from the first sample to `instant`, any shape."""
        interval = self._interval(instant)
        sample = torch.clamp(interval - 1, min=0)
        return self.integral[sample, channel] + self.slopes[interval, channel] * (instant - self.time[sample])

    def slope_at(self, instant: torch.Tensor, channel: int) -> torch.Tensor:
        """The slope of the integral up to `instant`: the signal's mean between the samples around it."""
        return self.slopes[self._interval(instant), channel]

    def average(
        self, start: torch.Tensor, step: torch.Tensor, channel: int, delay: torch.Tensor | float = 0.0
    ) -> torch.Tensor:
        """The mean over [start - delay, start + step - delay]; shapes broadcast."""
        begin = start - delay
        return (self.up_to(begin + step, channel) - self.up_to(begin, channel)) / step

    def _interval(self, instant: torch.Tensor) -> torch.Tensor:
        """Index of the slope that holds up to `instant`; at a sample the one before it, because a delay looks back."""
        return torch.searchsorted(self.time, instant.detach() - SAME_INSTANT)
