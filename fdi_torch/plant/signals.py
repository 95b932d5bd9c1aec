"""Time inside a simulation: the clock of one step, and held or linear signals averaged exactly over it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.recording import Hold

SAME_INSTANT = 1e-9  # s; closer than this, two instants differ by rounding only


@dataclass(frozen=True)
class Clock:
    """One integration step, or one sampling interval, [start, start + step] in s.

    resolution: the shortest time the integrator resolves, in s; it sets how sharply roots and rims are drawn.
    """

    start: Tensor
    step: Tensor
    resolution: Tensor

    @property
    def middle(self) -> Tensor:
        return self.start + 0.5 * self.step

    @property
    def end(self) -> Tensor:
        return self.start + self.step

    def share_after(self, instant: Tensor) -> Tensor:
        """The share of the step that lies after `instant`: a switch that no step needs to hit."""
        return torch.clamp((self.end - instant) / self.step, 0.0, 1.0)

    def risen(self, onset: Tensor, ramp: Tensor) -> Tensor:
        """The mean over the step of a rise from 0 to 1 that begins at `onset` and takes `ramp` seconds, exactly."""
        return (_rise_integral(self.end - onset, ramp) - _rise_integral(self.start - onset, ramp)) / self.step

    def risen_by_end(self, onset: Tensor, ramp: Tensor) -> Tensor:
        """The same rise as a sample at the step's end sees it, drawn over one sampling interval where it is abrupt.

        A sample at the onset or later sees an abrupt rise in full, so that an onset of 0 has always been there.
        """
        return torch.clamp((self.end - onset + self.step) / (torch.clamp(ramp, min=0.0) + self.step), 0.0, 1.0)

    def decay(self, time_constant: Tensor) -> Tensor:
        """exp(-step / time constant); exactly 0, with slope 0, where the time constant vanishes beside the step."""
        ratio = torch.clamp(time_constant / self.step, min=1e-3)
        return torch.exp(-1.0 / ratio)

    def sine(self, period: Tensor, phase: Tensor) -> Tensor:
        """The mean of sin(2 pi t / period + phase) over the step."""
        half = math.pi * self.step / period
        return torch.sin(2.0 * math.pi * self.middle / period + phase) * torch.sin(half) / half


def _rise_integral(since: Tensor, ramp: Tensor) -> Tensor:
    """The integral of a rise from 0 to 1 within `ramp` (s), up to `since` seconds after it began."""
    after = torch.clamp(since, min=0.0)
    rising = torch.minimum(after, ramp)
    return after - rising + 0.5 * rising * (rising / torch.clamp(ramp, min=1e-9))


class CumulativeSignal:
    """The integral of an input channel, so that its mean over any interval is exact, delayed or not.

    time (T,) s, values (T, C). A held signal is integrated exactly between all instants; a linear one at its samples.
    Before the first sample the signal is what it is there; after the last one likewise.
    """

    def __init__(self, time: Tensor, values: Tensor, hold: Hold) -> None:
        self.time = time
        mean = values[:-1] if hold == "zero_order" else 0.5 * (values[:-1] + values[1:])
        self.slopes = torch.cat([values[:1], mean, values[-1:]])  # slope of the integral before, between, after samples
        steps = torch.diff(time).unsqueeze(1)
        self.integral = torch.cat([torch.zeros_like(values[:1]), torch.cumsum(mean * steps, dim=0)])

    def up_to(self, instant: Tensor, channel: int) -> Tensor:
        """The integral from the first sample to `instant`, any shape."""
        after = self._interval(instant)
        left = torch.clamp(after - 1, min=0)
        return self.integral[left, channel] + self.slopes[after, channel] * (instant - self.time[left])

    def slope_at(self, instant: Tensor, channel: int) -> Tensor:
        """The slope of the integral up to `instant`: the signal's mean between the samples around it."""
        return self.slopes[self._interval(instant), channel]

    def average(self, start: Tensor, step: Tensor, channel: int, delay: Tensor | float = 0.0) -> Tensor:
        """The mean over [start - delay, start + step - delay]; shapes broadcast."""
        begin = start - delay
        return (self.up_to(begin + step, channel) - self.up_to(begin, channel)) / step

    def _interval(self, instant: Tensor) -> Tensor:
        """Which slope holds up to `instant`; at a switch the one before it: a delay reaches back, never ahead."""
        return torch.searchsorted(self.time, instant.detach() - SAME_INSTANT)
