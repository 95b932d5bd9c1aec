"""What every engine answers: readings, their Jacobian, and sums over samples that need no trajectory to be kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


@dataclass(frozen=True)
class Readings:
    """What was read, to be compared with what an engine predicts.

    values and weight: (S, C) for all lanes, or (problems, S, C), one set for each problem. weight 0 masks a reading.
    ar: None, or the AR(1) coefficient of each channel's noise, (C,) or (problems, C): residuals and Jacobians are
    whitened, x_k - ar x_(k-1); the first sample, and one after a masked one, is scaled by sqrt(1 - ar^2) instead.
    """

    values: Tensor
    weight: Tensor
    ar: Tensor | None = None

    @property
    def count(self) -> Tensor:
        """The number of readings that count, (C,) or (problems, C)."""
        return self.weight.sum(dim=-2)

    @property
    def centred(self) -> Tensor:
        """Values less their channel's mean; zero where masked."""
        filled = torch.where(self.weight > 0, self.values, torch.zeros_like(self.values))
        mean = (filled * self.weight).sum(dim=-2, keepdim=True) / self.count.unsqueeze(-2).clamp(min=1.0)
        return torch.where(self.weight > 0, filled - mean, torch.zeros_like(filled))

    def of(self, lanes: Tensor) -> Readings:
        """The sets of some problems; readings shared by all are passed on as they are."""
        if self.values.dim() == 2:
            return self
        return Readings(self.values[lanes], self.weight[lanes], self.ar[lanes] if self.ar is not None else None)


class Engine(Protocol):
    """A plant under one experiment, run for many parameter vectors at once."""

    name: str

    def readings(self, theta: Tensor) -> Tensor:
        """theta (*batch, P) -> readings (*batch, S, C) in SI."""
        ...

    def levels(self, theta: Tensor) -> Tensor:
        """theta (*batch, P) -> tank levels at the samples (*batch, S, tanks), m."""
        ...

    def linearise(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """theta (*batch, P) -> readings (*batch, S, C) and their Jacobian (*batch, S, C, P), forward mode."""
        ...

    def moments(self, theta: Tensor, data: Readings) -> Tensor:
        """theta (problems, N, P) -> weighted sums of r, r^2 and r y' over the samples, (problems, N, C, 3).

        r = y - prediction, y' = y - mean(y). With the sums of y alone they give likelihood and correlation.
        """
        ...

    def gram(self, theta: Tensor, data: Readings) -> Tensor:
        """theta (problems, N, P) -> weighted sums of products of [d prediction/d theta, r, y', 1].

        (problems, N, C, P+3, P+3).
        """
        ...
