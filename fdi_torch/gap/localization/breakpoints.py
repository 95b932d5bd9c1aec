"""Functions of a signal with a kink or a jump, at many breakpoints, relays, and functions of a signal's past.

    factor * max(x - c, 0)        factor where x >= c, otherwise 0        factor where a relay of x is on, otherwise 0

Products of kinks and jumps with weights w need only sums over x >= c, of w and of x w: cumulative sums over the sorted
signal. All breakpoints together cost hardly more than one function.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.gap.localization.regressors import relay


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


@dataclass(frozen=True)
class Relays:
    """x (K,): the signal. factor (K,). thresholds (N, 2): the lower and the upper one of each relay."""

    x: Tensor
    factor: Tensor
    thresholds: Tensor

    @cached_property
    def _on(self) -> Tensor:
        """Whether each relay is on, (N, K)."""
        return relay(self.x, self.thresholds)

    def function(self, i: int) -> Tensor:
        """The function (K,) of the i-th relay."""
        return self.factor * self._on[i]

    def products(self, weights: Tensor) -> Tensor:
        """Products (N, W) of all functions with weights (W, K)."""
        return self._on.to(weights.dtype) @ (self.factor * weights).T

    def functions_at(self, thresholds: Tensor) -> Tensor:
        """The functions (M, K) with other thresholds (M, 2)."""
        return self.factor * relay(self.x, thresholds)


@dataclass(frozen=True)
class Curves:
    """Functions that depend on the past of a signal, as their values (N, K)."""

    values: Tensor

    def function(self, i: int) -> Tensor:
        """The i-th function (K,)."""
        return self.values[i]

    def products(self, weights: Tensor) -> Tensor:
        """Products (N, W) of all functions with weights (W, K)."""
        return self.values @ weights.T


def _sums_from(x: Tensor) -> Tensor:
    """Sums (W, K+1) of x (W, K) from each column to the last one."""
    return torch.nn.functional.pad(x.flip(-1).cumsum(dim=-1).flip(-1), (0, 1))
