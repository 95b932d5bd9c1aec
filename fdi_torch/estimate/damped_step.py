"""Damped Newton steps of a batch of quadratic models within bounds, and the decrease that the models predict.

All equations are scaled by 1 / sqrt(diagonal of the curvature) (Marquardt 1963): the scaled curvature has a unit
diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fdi_torch.estimate.batch_algebra import apply, dot, solve_positive
from fdi_torch.estimate.linearisation import held_back

_RIDGE = 1e-10  # relative to the unit diagonal: regularises combinations of parameters without curvature
_MAX_CORRECTION_RATIO = 0.75  # largest 2 |correction| / |step| (Transtrum and Sethna 2012, section 3.2)


@dataclass(frozen=True)
class Quadratic:
    """Quadratic models of L independent problems (lanes) within [low, high].

    theta, gradient: (L, P). curvature: (L, P, P).
    """

    theta: Tensor
    gradient: Tensor
    curvature: Tensor
    low: Tensor
    high: Tensor

    @property
    def unit(self) -> Float[Tensor, "L P"]:
        """Scale of each parameter, 1 / sqrt(H_ii); one where the cost has no curvature."""
        diagonal = self.curvature.diagonal(dim1=-2, dim2=-1)
        return torch.where(diagonal > 0, 1.0 / torch.where(diagonal > 0, diagonal, 1.0).sqrt(), 1.0)

    def damped(self, damping: Float[Tensor, " L"]) -> Float[Tensor, "L P P"]:
        """The scaled curvature with `damping` added to its diagonal."""
        unit = self.unit
        eye = torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device)
        return self.curvature * unit[..., :, None] * unit[..., None, :] + damping[..., None, None] * eye

    def held(self) -> Bool[Tensor, "L P"]:
        """Parameters at an active bound."""
        return held_back(self.theta, self.gradient, self.low, self.high)


@dataclass(frozen=True)
class Step:
    """A step of each of L independent problems (lanes).

    trial (L, P): the point reached. predicted (L,): decrease of the cost according to the undamped model.
    solvable (L,): whether the damped model has a minimum.
    """

    trial: Tensor
    predicted: Tensor
    solvable: Tensor

    def __getitem__(self, keep: Tensor) -> Step:
        return Step(self.trial[keep], self.predicted[keep], self.solvable[keep])


def newton_decrement(model: Quadratic) -> tuple[Float[Tensor, " L"], Bool[Tensor, " L"]]:
    """g'H^-1 g / 2 over the free parameters, (L,), and whether H is positive definite there, (L,) bool."""
    free = ~model.held()
    scaled_gradient = torch.where(free, model.gradient * model.unit, 0.0)
    ridge = torch.full_like(scaled_gradient[..., 0], _RIDGE)
    newton, positive = solve_positive(_reduced(model.damped(ridge), free), scaled_gradient)
    return 0.5 * dot(scaled_gradient, newton), positive


def damped_step(model: Quadratic, damping: Float[Tensor, " L"]) -> Step:
    """The damped Newton step within the bounds, damping (L,).

    A parameter that would leave its range is fixed at the bound, and the step of the others is solved again until all
    lie within the bounds (active-set method).
    """
    theta, unit = model.theta, model.unit
    scaled_gradient, curvature = model.gradient * unit, model.damped(damping)
    fixed, fixed_at = model.held(), theta  # fixed_at: values of the fixed parameters
    solvable = torch.ones_like(damping, dtype=torch.bool)
    while True:
        move = torch.where(fixed, (fixed_at - theta) / unit, 0.0)
        right = torch.where(fixed, 0.0, -(scaled_gradient + apply(curvature, move)))
        newton, positive = solve_positive(_reduced(curvature, ~fixed), right)
        solvable = solvable & positive
        trial = torch.where(fixed, fixed_at, theta + newton * unit)
        outside = ~fixed & ((trial < model.low) | (trial > model.high))
        if not bool(outside.any()):
            break
        fixed_at = torch.where(outside, trial.clamp(model.low, model.high), fixed_at)
        fixed = fixed | outside
    change = trial - theta
    predicted = -(dot(model.gradient, change) + 0.5 * dot(change, apply(model.curvature, change)))
    return Step(trial, predicted, solvable)


def second_order_step(
    model: Quadratic, damping: Float[Tensor, " L"], trial: Float[Tensor, "L P"], nonlinearity: Float[Tensor, "L P"]
) -> tuple[Float[Tensor, "L P"], Bool[Tensor, " L"]]:
    """The step to `trial` (L, P) with its second-order correction, (L, P), and whether it is valid, (L,) bool.

    nonlinearity (L, P): J'c, with c = r(theta + step) - r(theta) - J step, the nonlinear part of the change of the
    residuals. The correction -(H + damping diag H)^-1 J'c is invalid if it is not finite or too long relative to the
    step.
    """
    unit = model.unit
    free = (trial > model.low) & (trial < model.high)
    rhs = torch.where(free, -nonlinearity * unit, 0.0)
    correction, positive = solve_positive(_reduced(model.damped(damping), free), rhs)
    step = (trial - model.theta) / unit
    short_enough = 4.0 * dot(correction, correction) < _MAX_CORRECTION_RATIO**2 * dot(step, step)
    corrected = (trial + correction * unit).clamp(model.low, model.high)
    return corrected, positive & short_enough & torch.isfinite(corrected).all(-1)


def _reduced(curvature: Tensor, free: Tensor) -> Tensor:
    """The curvature with the rows and columns of fixed parameters replaced by those of the identity."""
    eye = torch.eye(free.shape[-1], dtype=curvature.dtype, device=curvature.device)
    return torch.where(free[..., :, None] & free[..., None, :], curvature, eye)
