"""What every refinement returns, and the box it works in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

STATUSES = ("running", "converged", "stalled", "max_iterations", "failed")
RUNNING, CONVERGED, STALLED, MAX_ITERATIONS, FAILED = range(len(STATUSES))


@dataclass(frozen=True)
class Refined:
    """Where each member ended. `failed`: the cost or its derivatives were not finite at the start, which is returned.

    curvature is that of the last linearisation, the prior included; None where the method has none. promised tells how
    far from an optimum a member ended that did not converge: for a negative log-likelihood, sqrt(2 promised) standard
    errors; not finite where unknown.
    """

    theta: Tensor  # (*batch, P)
    cost: Tensor  # (*batch)
    gradient: Tensor  # (*batch, P)
    curvature: Tensor | None  # (*batch, P, P)
    promised: Tensor  # (*batch), decrease of the cost that the method still expected
    held: Tensor  # (*batch, P) bool: at a bound, against which the cost pushes
    status: Tensor  # (*batch) int64, place in STATUSES
    iterations: Tensor  # (*batch) int64

    def statuses(self) -> list[str]:
        """The status of each member in words, flattened."""
        return [STATUSES[code] for code in self.status.flatten().tolist()]

    def unflatten(self, shape: torch.Size) -> Refined:
        """From one flat leading dimension to that of the batch."""
        values = {name: None if v is None else v.reshape((*shape, *v.shape[1:])) for name, v in vars(self).items()}
        return Refined(**values)  # type: ignore[arg-type]

    def file(self, lanes: Tensor, **values: Tensor) -> Refined:
        """The same with the members `lanes` (L,) of the named fields replaced."""
        changed = {name: getattr(self, name).index_copy(0, lanes, value) for name, value in values.items()}
        return replace(self, **changed)

    def filed(
        self, lanes: Tensor, status: Tensor, iteration: int, box: tuple[Tensor, Tensor], **found: Tensor
    ) -> Refined:
        """The same with what has become of those of the members `lanes` (L,) that are no longer running.

        box: low and high (L, P), from which follows what was held back. found: the other fields, (L, ...) each.
        """
        done = status != RUNNING
        if not bool(done.any()):
            return self
        found["held"] = held_back(found["theta"], found["gradient"], *box)
        found |= {"status": status, "iterations": torch.full_like(lanes, iteration)}
        return self.file(lanes[done], **{name: value[done] for name, value in found.items()})


def unfinished(start: Tensor, with_curvature: bool) -> Refined:
    """To be filled in: start (B, P), nothing known."""
    count, parameters = start.shape
    zeros = torch.zeros(count, dtype=torch.int64, device=start.device)
    curvature = start.new_full((count, parameters, parameters), math.nan) if with_curvature else None
    return Refined(
        theta=start,
        cost=start.new_full((count,), math.inf),
        gradient=torch.full_like(start, math.nan),
        curvature=curvature,
        promised=start.new_full((count,), math.nan),
        held=torch.zeros_like(start, dtype=torch.bool),
        status=zeros,
        iterations=zeros,
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


def finite(cost: Tensor, gradient: Tensor) -> Tensor:
    """cost (L,), gradient (L, P) -> (L,) bool."""
    return torch.isfinite(cost) & torch.isfinite(gradient).all(-1)
