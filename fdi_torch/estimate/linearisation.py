"""What a least-squares problem provides to `levenberg_marquardt`, a quadratic model and trials without derivatives, and
the result of a batch of refinements.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, Self, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

STATUSES = ("running", "converged", "stalled", "max_iterations", "failed", "abandoned")
RUNNING, CONVERGED, STALLED, MAX_ITERATIONS, FAILED, ABANDONED = range(len(STATUSES))


class State(Protocol):
    """Data that a problem attaches to the current point of each lane; the first dimension is L throughout."""

    def lanes(self, which: Tensor) -> Self:
        """Select lanes by index (int64) or mask (bool)."""

    def replaced(self, which: Tensor, new: Self) -> Self:
        """A copy in which the k-th lane of `new` replaces lane `which[k]` (int64)."""


@dataclass(frozen=True)
class Refined:
    """Final point of each member of a batch of refinements.

    status: 'failed' means that the cost or its derivatives were not finite at the start, which is returned.
    gradient, curvature: of the last linearisation, priors included.
    newton_decrement: g' H^-1 g / 2, the decrease of the cost that the quadratic model still predicts. For a negative
    log-likelihood, the distance to the optimum is sqrt(2 newton_decrement) standard errors.
    state: data that the problem attaches to the final points; None for most problems.
    """

    theta: Tensor  # (*batch, P)
    cost: Tensor  # (*batch)
    gradient: Tensor  # (*batch, P)
    curvature: Tensor  # (*batch, P, P)
    newton_decrement: Tensor  # (*batch)
    held: Tensor  # (*batch, P) bool: parameters at an active bound
    status: Tensor  # (*batch) int64, index into STATUSES
    iterations: Tensor  # (*batch) int64
    state: State | None = None

    @property
    def converged(self) -> Tensor:
        """Which members converged, (*batch) bool."""
        return self.status == CONVERGED

    def statuses(self) -> list[str]:
        """Status of each member by name, flattened."""
        return [STATUSES[code] for code in self.status.flatten().tolist()]

    def unflatten(self, shape: torch.Size) -> Refined:
        """Restore the batch shape from one flat leading dimension; `state` remains flat."""
        return self._each(lambda value: value.reshape((*shape, *value.shape[1:])), self.state)

    def best(self) -> Refined:
        """The member of lowest finite cost in each row of a batch (B, K), as a batch (B)."""
        cost = torch.where(torch.isfinite(self.cost), self.cost, torch.inf)
        rows, best = torch.arange(len(cost), device=cost.device), cost.argmin(-1)
        state = None if self.state is None else self.state.lanes(rows * cost.shape[-1] + best)
        return self._each(lambda value: value[rows, best], state)

    def file(self, lanes: Tensor, state: State | None = None, **values: Tensor) -> Refined:
        """A copy in which members `lanes` (L,) of the named fields, and of the state, are replaced."""
        changed = {name: getattr(self, name).index_copy(0, lanes, value) for name, value in values.items()}
        new_state = self.state if state is None or self.state is None else self.state.replaced(lanes, state)
        return replace(self, state=new_state, **changed)

    def _each(self, change: Callable[[Tensor], Tensor], state: State | None) -> Refined:
        """A copy with `change` applied to every tensor, and the given state."""
        return Refined(**{name: change(value) for name, value in vars(self).items() if name != "state"}, state=state)


def unfinished(start: Tensor, state: State | None) -> Refined:
    """Result before the first iteration: start (B, P) and its state; the other fields are placeholders."""
    count, parameters = start.shape
    zeros = torch.zeros(count, dtype=torch.int64, device=start.device)
    return Refined(
        theta=start,
        cost=start.new_full((count,), math.inf),
        gradient=torch.full_like(start, math.nan),
        curvature=start.new_full((count, parameters, parameters), math.nan),
        newton_decrement=start.new_full((count,), math.nan),
        held=torch.zeros_like(start, dtype=torch.bool),
        status=zeros,
        iterations=zeros,
        state=state,
    )


def flat_box(
    start: Float[Tensor, "*batch P"], low: Tensor, high: Tensor
) -> tuple[Float[Tensor, "B P"], Float[Tensor, "B P"], Float[Tensor, "B P"]]:
    """start (*batch, P) clamped to its box, with low and high, each (B, P). Raises ValueError for an empty box."""
    parameters = start.shape[-1]
    if not bool((low <= high).all()):
        raise ValueError("expected low <= high for every parameter, got an empty box; exchange or widen the bounds")
    low, high = (bound.to(start).expand(start.shape).reshape(-1, parameters) for bound in (low, high))
    return start.reshape(-1, parameters).clamp(low, high), low, high


def held_back(
    theta: Float[Tensor, "L P"], gradient: Float[Tensor, "L P"], low: Float[Tensor, "L P"], high: Float[Tensor, "L P"]
) -> Bool[Tensor, "L P"]:
    """Active bounds: theta is at the bound, and the cost would decrease beyond it."""
    return ((theta <= low) & (gradient >= 0)) | ((theta >= high) & (gradient <= 0))


def typical_size(
    theta: Float[Tensor, "L P"], low: Float[Tensor, "L P"], high: Float[Tensor, "L P"]
) -> Float[Tensor, "L P"]:
    """Scale of each parameter for the step tolerance: width of the box, or |theta| without a finite box."""
    width = high - low
    return torch.where(torch.isfinite(width), width, theta.abs())


def are_all_lanes(which: Tensor, count: int) -> bool:
    """Whether an index (int64) or mask (bool) selects all of `count` lanes in order, so that no copy is needed."""
    if which.dtype == torch.bool:
        return bool(which.all())
    return torch.equal(which, torch.arange(count, device=which.device))


@dataclass(frozen=True)
class Linearisation:
    """Quadratic model of the cost at a point: cost (L,), gradient (L, P), Gauss-Newton curvature (L, P, P).

    state: data that the problem attaches to this point and receives back with it; None if there are none.
    """

    cost: Tensor
    gradient: Tensor
    curvature: Tensor
    state: State | None = None

    def finite(self) -> Tensor:
        """Lanes whose cost, gradient and curvature are all finite, (L,) bool."""
        slopes = torch.isfinite(self.gradient).all(-1) & torch.isfinite(self.curvature).all(-1).all(-1)
        return torch.isfinite(self.cost) & slopes

    def __getitem__(self, keep: Tensor) -> Linearisation:
        if are_all_lanes(keep, len(self.cost)):
            return self
        state = None if self.state is None else self.state.lanes(keep)
        return Linearisation(self.cost[keep], self.gradient[keep], self.curvature[keep], state)

    def replaced(self, which: Tensor, new: Linearisation) -> Linearisation:
        """A copy in which the k-th lane of `new` replaces lane `which[k]` (int64)."""
        if len(which) == len(self.cost):
            return new
        state = self.state
        if state is not None and new.state is not None and len(which):
            state = state.replaced(which, new.state)
        return Linearisation(
            self.cost.index_copy(0, which, new.cost),
            self.gradient.index_copy(0, which, new.gradient),
            self.curvature.index_copy(0, which, new.curvature),
            state,
        )


Linearise = Callable[[Tensor, Tensor], Linearisation]


class Trial(Protocol):
    """Points whose cost is known, but not their derivatives."""

    @property
    def cost(self) -> Tensor:
        """Cost of each point, (L,)."""

    def __getitem__(self, keep: Tensor) -> Self:
        """Select lanes by index (int64)."""

    def replaced(self, which: Tensor, new: Self) -> Self:
        """A copy in which the k-th lane of `new` replaces lane `which[k]` (int64)."""


AnyTrial = TypeVar("AnyTrial", bound=Trial)


class Neighbourhood(Protocol[AnyTrial]):
    """A problem that computes points from the model at a nearby point, and their derivatives only where needed."""

    def attempt(self, theta: Tensor, known: Linearisation, step: Tensor, near: AnyTrial | None = None) -> AnyTrial:
        """The points theta (L, P). `step` (L, P) leads there from the points of the model `known`, or from `near`."""

    def nonlinearity(self, known: Linearisation, trial: AnyTrial, step: Tensor) -> Tensor:
        """J'c (L, P) with c = r(theta + step) - r(theta) - J step, priors included; J is the Jacobian of `known`."""

    def model(self, theta: Tensor, trial: AnyTrial) -> Linearisation:
        """The model at the points of `trial`, theta (L, P)."""
