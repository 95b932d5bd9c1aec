"""What a refinement returns, and the box it works in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, Self

import torch
from torch import Tensor

STATUSES = ("running", "converged", "stalled", "max_iterations", "failed", "abandoned")
RUNNING, CONVERGED, STALLED, MAX_ITERATIONS, FAILED, ABANDONED = range(len(STATUSES))


class State(Protocol):
    """What a problem keeps of a point of each lane, first dimension L throughout."""

    def lanes(self, which: Tensor) -> Self:
        """Some of the lanes, by place (int64) or by choice (bool)."""

    def replaced(self, which: Tensor, new: Self) -> Self:
        """The same with the lanes at places `which` (int64) as `new` has them, in this order."""


@dataclass(frozen=True)
class Refined:
    """Where each member ended. `failed`: the cost or its derivatives were not finite at the start, which is returned.

    curvature is that of the last linearisation, the prior included. promised, the Newton decrement, tells how far from
    an optimum a member ended that did not converge: for a negative log-likelihood, sqrt(2 promised) standard errors.
    state: what the problem keeps of the end points, None for most problems.
    """

    theta: Tensor  # (*batch, P)
    cost: Tensor  # (*batch)
    gradient: Tensor  # (*batch, P)
    curvature: Tensor  # (*batch, P, P)
    promised: Tensor  # (*batch), decrease of the cost that the model still predicted
    held: Tensor  # (*batch, P) bool: at a bound, against which the cost pushes
    status: Tensor  # (*batch) int64, place in STATUSES
    iterations: Tensor  # (*batch) int64
    state: State | None = None

    @property
    def converged(self) -> Tensor:
        """(*batch) bool."""
        return self.status == CONVERGED

    def statuses(self) -> list[str]:
        """The status of each member in words, flattened."""
        return [STATUSES[code] for code in self.status.flatten().tolist()]

    def member(self, which: int) -> Refined:
        """One member of a flat batch, as a batch of one."""
        place = self.status.new_tensor([which])
        return self._each(lambda value: value[place], None if self.state is None else self.state.lanes(place))

    def unflatten(self, shape: torch.Size) -> Refined:
        """From one flat leading dimension to that of the batch; the state stays flat."""
        return self._each(lambda value: value.reshape((*shape, *value.shape[1:])), self.state)

    def best(self) -> Refined:
        """The member of lowest cost in each row of a batch (B, K), as a batch (B)."""
        cost = torch.where(torch.isfinite(self.cost), self.cost, torch.inf)
        rows, best = torch.arange(len(cost), device=cost.device), cost.argmin(-1)
        state = None if self.state is None else self.state.lanes(rows * cost.shape[-1] + best)
        return self._each(lambda value: value[rows, best], state)

    def file(self, lanes: Tensor, state: State | None = None, **values: Tensor) -> Refined:
        """The same with the members `lanes` (L,) of the named fields, and of the state, replaced."""
        changed = {name: getattr(self, name).index_copy(0, lanes, value) for name, value in values.items()}
        kept = self.state if state is None or self.state is None else self.state.replaced(lanes, state)
        return replace(self, state=kept, **changed)

    def _each(self, change: Callable[[Tensor], Tensor], state: State | None) -> Refined:
        """The same with every tensor changed."""
        return Refined(**{name: change(value) for name, value in vars(self).items() if name != "state"}, state=state)


def unfinished(start: Tensor, state: State | None) -> Refined:
    """To be filled in: start (B, P) and what the problem keeps there, nothing else known."""
    count, parameters = start.shape
    zeros = torch.zeros(count, dtype=torch.int64, device=start.device)
    return Refined(
        theta=start,
        cost=start.new_full((count,), math.inf),
        gradient=torch.full_like(start, math.nan),
        curvature=start.new_full((count, parameters, parameters), math.nan),
        promised=start.new_full((count,), math.nan),
        held=torch.zeros_like(start, dtype=torch.bool),
        status=zeros,
        iterations=zeros,
        state=state,
    )


def flat_box(start: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """start (*batch, P) brought into its box, low and high, each (B, P). Raises ValueError where a box is empty."""
    parameters = start.shape[-1]
    if not bool((low <= high).all()):
        raise ValueError("expected low <= high for every parameter, got an empty box; exchange or widen the bounds")
    low, high = (bound.to(start).expand(start.shape).reshape(-1, parameters) for bound in (low, high))
    return start.reshape(-1, parameters).clamp(low, high), low, high


def held_back(theta: Tensor, gradient: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Where a bound is active: the cost would fall beyond it. (..., P) bool."""
    return ((theta <= low) & (gradient >= 0)) | ((theta >= high) & (gradient <= 0))


def typical_size(theta: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """What a step is compared with, (..., P): the width of the box, or the value itself where there is no box."""
    width = high - low
    return torch.where(torch.isfinite(width), width, theta.abs())
