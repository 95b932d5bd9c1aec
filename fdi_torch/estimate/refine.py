"""Bounded Levenberg-Marquardt for a batch of problems that share nothing but the call.

Marquardt (1963): steps from (H + damping diag(H)) step = -g; damping updated as in Nielsen (1999), "Damping parameter
in Marquardt's method"; bounds by an active set. H is the Gauss-Newton curvature of the cost, priors included. The unit
of the cost matters once: for a negative log-likelihood, sqrt(g' H^-1 g) is the distance left in standard errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.batch_algebra import apply, dot, solve_positive
from fdi_torch.estimate.refined import (
    CONVERGED,
    FAILED,
    MAX_ITERATIONS,
    RUNNING,
    STALLED,
    Refined,
    flat_box,
    held_back,
    typical_size,
    unfinished,
)

_MOST_DAMPING, _LEAST_DAMPING = 1e14, 1e-12


@dataclass(frozen=True)
class Linearisation:
    """The cost's quadratic model at a point: cost (L,), gradient (L, P), curvature (L, P, P)."""

    cost: Tensor
    gradient: Tensor
    curvature: Tensor

    def finite(self) -> Tensor:
        """(L,) bool."""
        slopes = torch.isfinite(self.gradient).all(-1) & torch.isfinite(self.curvature).all(-1).all(-1)
        return torch.isfinite(self.cost) & slopes

    def __getitem__(self, keep: Tensor) -> Linearisation:
        return Linearisation(self.cost[keep], self.gradient[keep], self.curvature[keep])


Linearise = Callable[[Tensor, Tensor], Linearisation]


@dataclass(frozen=True)
class RefineSettings:
    """When to stop, and how bold to begin.

    decrease_tolerance: of the decrease of the cost that the model still promises, g' (H + damping diag H)^-1 g / 2.
    step_tolerance: of an accepted step, as a share of the box's width (of the value itself where there is no box).
    """

    iterations: int = 100
    decrease_tolerance: float = 1e-10
    step_tolerance: float = 1e-11
    damping: float = 1e-3

    def __post_init__(self) -> None:
        if self.iterations < 1 or not self.damping > 0 or min(self.decrease_tolerance, self.step_tolerance) < 0:
            raise ValueError(f"expected iterations >= 1, damping > 0 and tolerances >= 0, got {self}; change them")


@dataclass(frozen=True)
class Progress:
    """One iteration, for whoever looks on; all have one leading dimension: the members still at work."""

    iteration: int
    lanes: Tensor  # (L,) place in the flattened batch
    theta: Tensor  # (L, P)
    cost: Tensor  # (L,)
    promised: Tensor  # (L,) decrease of the cost that the model promised before the step
    damping: Tensor  # (L,)
    accepted: Tensor  # (L,) bool


@dataclass(frozen=True)
class _Members:
    """The members still at work, one flat leading dimension L."""

    lanes: Tensor
    theta: Tensor
    low: Tensor
    high: Tensor
    model: Linearisation
    damping: Tensor
    growth: Tensor  # Nielsen's nu
    promised: Tensor  # decrease of the cost promised by the model when last trusted
    settled: Tensor  # bool: the last step was below the tolerance

    def __getitem__(self, keep: Tensor) -> _Members:
        return _Members(*(value[keep] for value in vars(self).values()))


@dataclass(frozen=True)
class _Step:
    trial: Tensor  # (L, P)
    predicted: Tensor  # (L,) decrease of the cost by the model, bounds respected
    promised: Tensor  # (L,) decrease as if no further bound were met
    solvable: Tensor  # (L,) bool

    def __getitem__(self, keep: Tensor) -> _Step:
        return _Step(*(value[keep] for value in vars(self).values()))


def levenberg_marquardt(
    linearise: Linearise,
    start: Tensor,
    low: Tensor,
    high: Tensor,
    settings: RefineSettings | None = None,
    on_iteration: Callable[[Progress], None] | None = None,
) -> Refined:
    """Minimises the cost of every member from `start` (*batch, P) within [low, high], which broadcast.

    `linearise(theta (L, P), lanes (L,))` gives the model at theta for the members `lanes` of the flattened batch; those
    that finish leave. A trial whose model is not finite is refused; a start whose model is not finite is "failed".
    """
    settings = settings or RefineSettings()
    theta, low, high = flat_box(start, low, high)
    result = unfinished(theta, with_curvature=True)
    members = _begin(linearise, theta, low, high, settings)
    iteration = 0
    while len(members.lanes):
        step = _step(members)
        members = replace(members, promised=torch.where(_trusted(members, step), step.promised, members.promised))
        status = _status(members, step, iteration, settings)
        found = {"theta": members.theta, "promised": members.promised, **vars(members.model)}
        result = result.filed(members.lanes, status, iteration, (members.low, members.high), **found)
        members, step = members[status == RUNNING], step[status == RUNNING]
        if not len(members.lanes):
            break
        members, accepted = _advance(members, step, linearise(step.trial, members.lanes), settings)
        iteration += 1
        if on_iteration is not None:
            values = (members.lanes, members.theta, members.model.cost, step.promised, members.damping, accepted)
            on_iteration(Progress(iteration, *values))
    return result.unflatten(start.shape[:-1])


def _begin(linearise: Linearise, theta: Tensor, low: Tensor, high: Tensor, settings: RefineSettings) -> _Members:
    lanes = torch.arange(len(theta), device=theta.device)
    model = linearise(theta, lanes)
    shapes = tuple(tuple(value.shape) for value in (model.cost, model.gradient, model.curvature))
    count, parameters = theta.shape
    if shapes != ((count,), (count, parameters), (count, parameters, parameters)):
        raise ValueError(
            f"expected cost (L,), gradient (L, P) and curvature (L, P, P) for L = {count} and P = {parameters}, "
            f"got {shapes}; make `linearise` return one of each for every lane"
        )
    damping = torch.full_like(model.cost, settings.damping)
    growth, promised = torch.full_like(model.cost, 2.0), torch.full_like(model.cost, math.inf)
    settled = torch.zeros_like(lanes, dtype=torch.bool)
    return _Members(lanes, theta, low, high, model, damping, growth, promised, settled)


def _step(members: _Members) -> _Step:
    """The damped Newton step on the free parameters; those that meet a bound stop there and the others solve again."""
    theta, low, high, model = members.theta, members.low, members.high, members.model
    diagonal = model.curvature.diagonal(dim1=-2, dim2=-1)
    # Marquardt's scaling: in units of 1/sqrt(diagonal) the curvature has a diagonal of ones (or of zeros).
    unit = torch.where(diagonal > 0, 1.0 / torch.where(diagonal > 0, diagonal, 1.0).sqrt(), 1.0)
    slope = model.gradient * unit
    eye = torch.eye(theta.shape[-1], dtype=theta.dtype, device=theta.device)
    curvature = model.curvature * unit[..., :, None] * unit[..., None, :] + members.damping[..., None, None] * eye
    fixed = held_back(theta, model.gradient, low, high)
    goal = theta  # where the fixed parameters go
    promised = solvable = None
    while True:
        move = torch.where(fixed, (goal - theta) / unit, 0.0)
        free = ~fixed
        reduced = torch.where(free[..., :, None] & free[..., None, :], curvature, eye)
        right = torch.where(free, -(slope + apply(curvature, move)), 0.0)
        newton, positive = solve_positive(reduced, right)
        if promised is None or solvable is None:
            promised, solvable = 0.5 * dot(right, newton), positive
        solvable = solvable & positive
        trial = torch.where(fixed, goal, theta + newton * unit)
        beyond = free & ((trial < low) | (trial > high))
        if not bool(beyond.any()):
            break
        goal = torch.where(beyond, trial.clamp(low, high), goal)
        fixed = fixed | beyond
    change = trial - theta
    predicted = -(dot(model.gradient, change) + 0.5 * dot(change, apply(model.curvature, change)))
    return _Step(trial, predicted, promised, solvable)


def _status(members: _Members, step: _Step, iteration: int, settings: RefineSettings) -> Tensor:
    """(L,) place in STATUSES. What lies below the rounding of the cost counts as nothing."""
    rounding = 64.0 * torch.finfo(members.theta.dtype).eps * members.model.cost.abs()
    small = step.promised <= rounding.clamp(min=settings.decrease_tolerance)
    converged = step.solvable & small & _trusted(members, step)
    status = torch.full_like(members.lanes, MAX_ITERATIONS if iteration >= settings.iterations else RUNNING)
    status = torch.where(members.damping > _MOST_DAMPING, STALLED, status)
    status = torch.where(converged | members.settled, CONVERGED, status)
    return torch.where(members.model.finite(), status, FAILED)


def _trusted(members: _Members, step: _Step) -> Tensor:
    """Whether the promise tells the distance to an optimum: not so under heavy damping, unless it is exactly zero."""
    return (members.damping <= 1.0) | (step.promised == 0)


def _advance(members: _Members, step: _Step, model: Linearisation, settings: RefineSettings) -> tuple[_Members, Tensor]:
    """Accepts or refuses each member's trial and updates its damping (Nielsen 1999, eq. 2.6)."""
    decrease = members.model.cost - model.cost
    accepted = step.solvable & model.finite() & (decrease > 0) & (step.predicted > 0)
    gain = 2.0 * decrease / torch.where(accepted, step.predicted, 1.0) - 1.0
    eased = members.damping * (1.0 - gain * gain * gain).clamp(1.0 / 3.0, 2.0)
    change = (step.trial - members.theta).abs()
    tiny = (change <= settings.step_tolerance * typical_size(members.theta, members.low, members.high)).all(-1)
    kept = replace(
        members,
        theta=torch.where(accepted[:, None], step.trial, members.theta),
        model=_chosen(accepted, model, members.model),
        damping=torch.where(accepted, eased, members.damping * members.growth).clamp(min=_LEAST_DAMPING),
        growth=torch.where(accepted, 2.0, 2.0 * members.growth),
        settled=accepted & tiny & (members.damping <= 1.0),
    )
    return kept, accepted


def _chosen(first: Tensor, a: Linearisation, b: Linearisation) -> Linearisation:
    return Linearisation(
        torch.where(first, a.cost, b.cost),
        torch.where(first[:, None], a.gradient, b.gradient),
        torch.where(first[:, None, None], a.curvature, b.curvature),
    )
