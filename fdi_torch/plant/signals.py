"""Time inside a simulation: the clock of one step, and held or linear signals averaged exactly over it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.recording import Hold


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
        after = torch.searchsorted(self.time, instant.detach().contiguous(), right=True)
        left = torch.clamp(after - 1, min=0)
        return self.integral[left, channel] + self.slopes[after, channel] * (instant - self.time[left])

    def slope_at(self, instant: Tensor, channel: int) -> Tensor:
        """The slope of the integral just after `instant`: the signal's mean between the samples around it."""
        return self.slopes[torch.searchsorted(self.time, instant.detach().contiguous(), right=True), channel]

    def average(self, start: Tensor, step: Tensor, channel: int, delay: Tensor | float = 0.0) -> Tensor:
        """The mean over [start - delay, start + step - delay]; shapes broadcast."""
        begin = start - delay
        return (self.up_to(begin + step, channel) - self.up_to(begin, channel)) / step
