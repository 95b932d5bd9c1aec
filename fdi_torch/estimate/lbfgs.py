"""Refinement with gradients alone: L-BFGS for a batch of problems that share nothing but the call.

Steps are measured in each parameter's `typical_size`, so that units do not matter; the box is kept by projection.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.batch_algebra import dot
from fdi_torch.estimate.refined import (
    CONVERGED,
    FAILED,
    MAX_ITERATIONS,
    RUNNING,
    STALLED,
    Refined,
    finite,
    flat_box,
    held_back,
    typical_size,
    unfinished,
)

ValueAndGradient = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class LbfgsSettings:
    """iterations: evaluations of each member. decrease_tolerance: of the decrease of the cost still expected.

    memory: pairs of step and change of gradient that are kept.
    """

    iterations: int = 500
    decrease_tolerance: float = 1e-10
    memory: int = 10

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.memory < 1 or self.decrease_tolerance < 0:
            raise ValueError(f"expected iterations, memory >= 1 and a tolerance >= 0, got {self}; change them")


@dataclass(frozen=True)
class _Members:
    """The members still at work, one flat leading dimension L."""

    lanes: Tensor
    theta: Tensor
    low: Tensor
    high: Tensor
    size: Tensor  # (L, P)
    cost: Tensor
    gradient: Tensor
    steps: Tensor  # (L, M, P), newest last
    changes: Tensor  # (L, M, P), of the gradient along them
    inverse: Tensor  # (L, M), 1 / (step . change); 0 for no pair
    direction: Tensor  # (L, P)
    reach: Tensor  # (L,), how far along it the next trial goes

    def __getitem__(self, keep: Tensor) -> _Members:
        return _Members(*(value[keep] for value in vars(self).values()))


def lbfgs(
    value_and_gradient: ValueAndGradient,
    start: Tensor,
    low: Tensor,
    high: Tensor,
    settings: LbfgsSettings | None = None,
    on_iteration: Callable[[int, Tensor, Tensor, Tensor], None] | None = None,
) -> Refined:
    """Minimises the cost of every member from `start` (*batch, P) by L-BFGS (Nocedal 1980) with projection on the box.

    `value_and_gradient(theta (L, P), lanes (L,))` -> cost (L,), gradient (L, P). Armijo backtracking, one evaluation an
    iteration; `on_iteration` gets iteration, lanes, theta and cost.
    """
    settings = settings or LbfgsSettings()
    theta, low, high = flat_box(start, low, high)
    result = unfinished(theta, with_curvature=False)
    members = _directed(_begin(value_and_gradient, theta, low, high, settings))
    for iteration in range(settings.iterations + 1):
        expected = -0.5 * dot(members.gradient, members.direction * members.size)
        status = _status(members, expected, iteration, settings)
        found = {"theta": members.theta, "cost": members.cost, "gradient": members.gradient, "promised": expected}
        result = result.filed(members.lanes, status, iteration, (members.low, members.high), **found)
        members = members[status == RUNNING]
        if not len(members.lanes):
            break
        members = _advance(members, value_and_gradient)
        if on_iteration is not None:
            on_iteration(iteration + 1, members.lanes, members.theta, members.cost)
    return result.unflatten(start.shape[:-1])


def _begin(function: ValueAndGradient, theta: Tensor, low: Tensor, high: Tensor, settings: LbfgsSettings) -> _Members:
    lanes = torch.arange(len(theta), device=theta.device)
    cost, gradient = function(theta, lanes)
    pairs = theta.new_zeros((*theta.shape[:-1], settings.memory, theta.shape[-1]))
    size = typical_size(theta, low, high)
    return _Members(
        lanes=lanes,
        theta=theta,
        low=low,
        high=high,
        size=torch.where(size > 0, size, 1.0),
        cost=cost,
        gradient=gradient,
        steps=pairs,
        changes=pairs,
        inverse=pairs[..., 0],
        direction=torch.zeros_like(theta),
        reach=torch.ones_like(cost),
    )


def _directed(members: _Members) -> _Members:
    """With the direction of the two-loop recursion (Nocedal & Wright 2006, algorithm 7.4) on the free parameters."""
    held = held_back(members.theta, members.gradient, members.low, members.high)
    slope = torch.where(held, 0.0, members.gradient * members.size)
    rest, shares = slope, []
    for k in reversed(range(members.inverse.shape[-1])):
        share = members.inverse[:, k] * dot(members.steps[:, k], rest)
        rest = rest - share[:, None] * members.changes[:, k]
        shares.append(share)
    rest = rest * _first_scale(members, slope)[:, None]
    for k, share in enumerate(reversed(shares)):
        back = members.inverse[:, k] * dot(members.changes[:, k], rest)
        rest = rest + (share - back)[:, None] * members.steps[:, k]
    downhill = dot(rest, slope) > 0
    steepest = slope * _cautious(slope)[:, None]
    direction = torch.where(held, 0.0, -torch.where(downhill[:, None], rest, steepest))
    return replace(members, direction=direction, reach=torch.ones_like(members.cost))


def _cautious(slope: Tensor) -> Tensor:
    """A scale (L,) with which the largest step is a tenth of the typical size."""
    largest = slope.abs().amax(-1)
    return torch.where(largest > 0, 0.1 / torch.where(largest > 0, largest, 1.0), 1.0)


def _first_scale(members: _Members, slope: Tensor) -> Tensor:
    change = members.changes[:, -1]
    square = dot(change, change)
    known = members.inverse[:, -1] > 0
    scale = 1.0 / torch.where(known, members.inverse[:, -1] * square, 1.0)
    return torch.where(known, scale, _cautious(slope))


def _status(members: _Members, expected: Tensor, iteration: int, settings: LbfgsSettings) -> Tensor:
    rounding = 64.0 * torch.finfo(members.theta.dtype).eps * members.cost.abs()
    small = expected <= rounding.clamp(min=settings.decrease_tolerance)
    status = torch.full_like(members.lanes, MAX_ITERATIONS if iteration >= settings.iterations else RUNNING)
    no_pairs = (members.inverse == 0).all(-1)
    status = torch.where((members.reach < 1e-12) & no_pairs, STALLED, status)
    status = torch.where(small, CONVERGED, status)
    return torch.where(finite(members.cost, members.gradient), status, FAILED)


def _advance(members: _Members, function: ValueAndGradient) -> _Members:
    """One trial of each member; who succeeds gets a new direction, who fails tries half as far next time."""
    far = members.theta + members.reach[:, None] * members.direction * members.size
    trial = far.clamp(members.low, members.high)
    cost, gradient = function(trial, members.lanes)
    moved = trial - members.theta
    enough = cost <= members.cost + 1e-4 * dot(members.gradient, moved)
    accepted = finite(cost, gradient) & enough & (cost < members.cost)
    learned = _learned(members, moved / members.size, (gradient - members.gradient) * members.size, accepted)
    went = replace(
        learned,
        theta=torch.where(accepted[:, None], trial, members.theta),
        cost=torch.where(accepted, cost, members.cost),
        gradient=torch.where(accepted[:, None], gradient, members.gradient),
    )
    forget = ~accepted & (members.reach < 1e-6) & (members.inverse != 0).any(-1)
    went = replace(went, inverse=torch.where(forget[:, None], 0.0, went.inverse))
    fresh = _directed(went)
    again = accepted | forget
    return replace(
        went,
        direction=torch.where(again[:, None], fresh.direction, members.direction),
        reach=torch.where(again, 1.0, 0.5 * members.reach),
    )


def _learned(members: _Members, step: Tensor, change: Tensor, accepted: Tensor) -> _Members:
    """With the newest pair, where its curvature is positive."""
    curvature = dot(step, change)
    useful = accepted & (curvature > 1e-10 * (dot(step, step) * dot(change, change)).sqrt())
    inverse = 1.0 / torch.where(useful, curvature, 1.0)

    def pushed(old: Tensor, newest: Tensor) -> Tensor:
        mask = useful.reshape(-1, *(1,) * (old.dim() - 1))
        return torch.where(mask, torch.cat((old[:, 1:], newest[:, None]), 1), old)

    return replace(
        members,
        steps=pushed(members.steps, step),
        changes=pushed(members.changes, change),
        inverse=pushed(members.inverse, inverse),
    )
