"""What a least-squares problem provides to `levenberg_marquardt`: a quadratic model, and trials without derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self, TypeVar

import torch
from torch import Tensor

from fdi_torch.estimate.refined import State


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

    def bend(self, known: Linearisation, trial: AnyTrial, step: Tensor) -> Tensor:
        """J'c (L, P) with c = r(theta + step) - r(theta) - J step, priors included; J is the Jacobian of `known`."""

    def model(self, theta: Tensor, trial: AnyTrial) -> Linearisation:
        """The model at the points of `trial`, theta (L, P)."""
