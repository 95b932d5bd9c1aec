"""Functions of a signal with a kink or a jump, at many breakpoints.

    factor * max(x - c, 0)        factor where x >= c, otherwise 0

Their products with weights w need only sums over x >= c, of w and of x w: cumulative sums over the sorted signal. All
breakpoints together cost hardly more than one function.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Breakpoints:
    """x (K,): the signal. factor (K,). at (N,): the breakpoints c. jump: whether the functions jump there, or kink."""

    x: Tensor
    factor: Tensor
    at: Tensor
    jump: bool

    def function(self, i: int) -> Tensor:
        """The function (K,) with the i-th breakpoint."""
        c = self.at[i]
        return self.factor * ((self.x >= c) if self.jump else (self.x - c).clamp(min=0.0))

    def products(self, weights: Tensor) -> Tensor:
        """Products (N, W) of all functions with weights (W, K)."""
        order = torch.argsort(self.x)
        x, weights = self.x[order], (self.factor * weights)[:, order]
        first = torch.searchsorted(x, self.at)
        above = _sums_from(weights)[:, first]
        return (above if self.jump else _sums_from(x * weights)[:, first] - self.at * above).T


def _sums_from(x: Tensor) -> Tensor:
    """Sums (W, K+1) of x (W, K) from each column to the last one."""
    return torch.nn.functional.pad(x.flip(-1).cumsum(dim=-1).flip(-1), (0, 1))
