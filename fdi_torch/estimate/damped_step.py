"""Newton steps of a batch of quadratic models in their boxes, and what the models promise.

All work in Marquardt's units (1963), 1 / sqrt(diagonal of the curvature), in which the curvature's diagonal is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.batch_algebra import apply, dot, solve_positive
from fdi_torch.estimate.refined import held_back

_RIDGE = 1e-10  # of the unit diagonal: a combination of parameters that is known less well than so promises nothing
_MOST_BENT = 0.75  # twice a correction's length over the step's (Transtrum and Sethna 2012, section 3.2)


@dataclass(frozen=True)
class Quadratic:
    """The models of L lanes: gradient (L, P) and curvature (L, P, P) at theta (L, P) within [low, high]."""

    theta: Tensor
    gradient: Tensor
    curvature: Tensor
    low: Tensor
    high: Tensor

    @property
    def unit(self) -> Tensor:
        """Marquardt's units of the parameters, (L, P); one where nothing depends on a parameter."""
        diagonal = self.curvature.diagonal(dim1=-2, dim2=-1)
        return torch.where(diagonal > 0, 1.0 / torch.where(diagonal > 0, diagonal, 1.0).sqrt(), 1.0)

    def damped(self, damping: Tensor) -> Tensor:
        """The curvature in Marquardt's units plus `damping` (L,) on its diagonal, (L, P, P)."""
        unit = self.unit
        eye = torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device)
        return self.curvature * unit[..., :, None] * unit[..., None, :] + damping[..., None, None] * eye

    def held(self) -> Tensor:
        """Parameters that a bound stops, (L, P) bool."""
        return held_back(self.theta, self.gradient, self.low, self.high)


@dataclass(frozen=True)
class Step:
    """trial (L, P); predicted (L,): decrease of the cost by the model; solvable (L,): whether the damped model has a
    minimum.
    """

    trial: Tensor
    predicted: Tensor
    solvable: Tensor

    def __getitem__(self, keep: Tensor) -> Step:
        return Step(self.trial[keep], self.predicted[keep], self.solvable[keep])


def newton_decrement(model: Quadratic) -> tuple[Tensor, Tensor]:
    """g'H^-1 g / 2 over the parameters that no bound stops, (L,), and whether H is positive there, (L,) bool."""
    free = ~model.held()
    slope = torch.where(free, model.gradient * model.unit, 0.0)
    ridge = torch.full_like(slope[..., 0], _RIDGE)
    newton, positive = solve_positive(_reduced(model.damped(ridge), free), slope)
    return 0.5 * dot(slope, newton), positive


def damped_step(model: Quadratic, damping: Tensor) -> Step:
    """The damped Newton step on the free parameters; those that meet a bound stop there and the others solve again."""
    theta, unit = model.theta, model.unit
    slope, curvature = model.gradient * unit, model.damped(damping)
    fixed, goal = model.held(), theta  # goal: where the fixed parameters go
    solvable = torch.ones_like(damping, dtype=torch.bool)
    while True:
        move = torch.where(fixed, (goal - theta) / unit, 0.0)
        right = torch.where(fixed, 0.0, -(slope + apply(curvature, move)))
        newton, positive = solve_positive(_reduced(curvature, ~fixed), right)
        solvable = solvable & positive
        trial = torch.where(fixed, goal, theta + newton * unit)
        beyond = ~fixed & ((trial < model.low) | (trial > model.high))
        if not bool(beyond.any()):
            break
        goal = torch.where(beyond, trial.clamp(model.low, model.high), goal)
        fixed = fixed | beyond
    change = trial - theta
    predicted = -(dot(model.gradient, change) + 0.5 * dot(change, apply(model.curvature, change)))
    return Step(trial, predicted, solvable)


def bent_step(model: Quadratic, damping: Tensor, trial: Tensor, bend: Tensor) -> tuple[Tensor, Tensor]:
    """Where a step to `trial` (L, P) leads with its second-order correction, (L, P), and whether that is a correction.

    bend: J'c (L, P) for the residuals' bend c along the step. It is none where it is too long for its step, or no
    number.
    """
    unit = model.unit
    free = (trial > model.low) & (trial < model.high)
    right = torch.where(free, -bend * unit, 0.0)
    correction, positive = solve_positive(_reduced(model.damped(damping), free), right)
    step = (trial - model.theta) / unit
    short = 4.0 * dot(correction, correction) < _MOST_BENT**2 * dot(step, step)
    bent = (trial + correction * unit).clamp(model.low, model.high)
    return bent, positive & short & torch.isfinite(bent).all(-1)


def _reduced(curvature: Tensor, free: Tensor) -> Tensor:
    """The curvature of the free parameters, the identity for the others."""
    eye = torch.eye(free.shape[-1], dtype=curvature.dtype, device=curvature.device)
    return torch.where(free[..., :, None] & free[..., None, :], curvature, eye)
