"""Families of regressors: kinks and jumps of a signal, relays, periodic pulses, and functions of a signal's past.

    factor * max(x - c, 0)        factor where x >= c, otherwise 0        factor where a relay of x is on, otherwise 0

and pulses, factor during a share of each period. Products of kinks and jumps with weights w need only sums over x >= c,
of w and of x w: cumulative sums over the sorted signal. All breakpoints together cost hardly more than one function, as
do all pulses of one period.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.gap.localization.regressors import relay

PHASES = 24  # of a period, at which pulses begin and end
LONGEST = PHASES // 2


@dataclass(frozen=True)
class Breakpoints:
    """x (K,): the signal. factor (K,). at (N,): the breakpoints c. jump: whether the functions jump there, or kink."""

    x: Tensor
    factor: Tensor
    at: Tensor
    jump: bool

    def __len__(self) -> int:
        return len(self.at)

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

    @property
    def spacing(self) -> Tensor:
        """Distance of neighbours on the grid, (2,)."""
        return (self.thresholds[0, 1] - self.thresholds[0, 0]).expand(2)

    def parameters(self, i: int) -> Tensor:
        """The thresholds (2,) of the i-th relay."""
        return self.thresholds[i]

    def possible(self, thresholds: Tensor) -> Tensor:
        """Whether there are relays with these thresholds (M, 2), (M,) bool."""
        return thresholds[:, 0] < thresholds[:, 1]

    def __len__(self) -> int:
        return len(self.thresholds)

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
class Pulses:
    """Periodic pulses: draws by a timer, a float valve, a pump that cycles.

    time (K,): s. factor (K,). frequencies (F,): Hz. Each pulse has a frequency, a phase at its begin, and the share of
    the period that it lasts, up to a half; both are multiples of 1/PHASES. A longer one is a constant less a pulse.
    """

    time: Tensor
    factor: Tensor
    frequencies: Tensor

    def __len__(self) -> int:
        return len(self.frequencies) * PHASES * LONGEST

    @property
    def spacing(self) -> Tensor:
        """Grid spacing of the parameters, (3,). One step of the frequency shifts the last pulse by 1/PHASES periods."""
        return self.time.new_tensor([1.0 / float(self.time[-1]), 1.0, 1.0]) / PHASES

    def parameters(self, i: int) -> Tensor:
        """Frequency, begin and share of the i-th pulse, (3,)."""
        k, rest = divmod(i, PHASES * LONGEST)
        begin, length = divmod(rest, LONGEST)
        return self.time.new_tensor([float(self.frequencies[k]), begin / PHASES, (length + 1) / PHASES])

    def possible(self, parameters: Tensor) -> Tensor:
        """Whether there are pulses with these parameters (M, 3), (M,) bool."""
        return (parameters[:, 0] > 0.0) & (parameters[:, 2] > 0.0) & (parameters[:, 2] < 1.0)

    def function(self, i: int) -> Tensor:
        """The function (K,) of the i-th pulse."""
        return self.functions_at(self.parameters(i).unsqueeze(0))[0]

    def functions_at(self, parameters: Tensor) -> Tensor:
        """The functions (M, K) with other parameters (M, 3)."""
        frequency, begin, share = parameters.unsqueeze(-1).unbind(1)
        return self.factor * ((frequency * self.time - begin) % 1.0 < share)

    def products(self, weights: Tensor) -> Tensor:
        """Products (N, W) of all functions with weights (W, K)."""
        if not len(self):
            return weights.new_zeros(0, len(weights))
        phases = ((self.frequencies.unsqueeze(1) * self.time % 1.0) * PHASES).to(torch.int64).clamp(max=PHASES - 1)
        weights = (self.factor * weights).T.contiguous()
        sums = torch.stack([weights.new_zeros(PHASES, weights.shape[1]).index_add_(0, p, weights) for p in phases])
        sums = torch.nn.functional.pad(torch.cat([sums, sums], dim=1).cumsum(dim=1), (0, 0, 1, 0))
        begins = torch.arange(PHASES).unsqueeze(1)
        return (sums[:, begins + torch.arange(1, LONGEST + 1)] - sums[:, begins]).flatten(0, 2)


@dataclass(frozen=True)
class Curves:
    """Functions that depend on the past of a signal, as their values (N, K)."""

    values: Tensor

    def __len__(self) -> int:
        return len(self.values)

    def function(self, i: int) -> Tensor:
        """The i-th function (K,)."""
        return self.values[i]

    def products(self, weights: Tensor) -> Tensor:
        """Products (N, W) of all functions with weights (W, K)."""
        return self.values @ weights.T


def _sums_from(x: Tensor) -> Tensor:
    """Sums (W, K+1) of x (W, K) from each column to the last one."""
    return torch.nn.functional.pad(x.flip(-1).cumsum(dim=-1).flip(-1), (0, 1))
