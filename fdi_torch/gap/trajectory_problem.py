"""Least squares over parameters and trajectories: the problem that Levenberg-Marquardt solves.

The collocation engine improves a trajectory by one Newton step per evaluation. The costs of two points can therefore be
compared only where both trajectories satisfy the model: a step whose trajectory does not converge is rejected.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from fdi_torch.estimate.levenberg_marquardt import Linearisation
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint_collocation import JointCollocation

CORRECTIONS = 6  # most Newton steps after the parameters moved a trajectory
FAR = 1e-3  # largest defect of a converged trajectory, in units of the plant's length scale
LONG, NEARLY = 4.0, 10.0  # in units of FAR: a shift that needs corrections, a defect that one more correction removes
LOST, STALLED = 100.0, 0.9  # a defect above LOST * FAR that one correction reduces by less than 10 % has diverged


class Objective(Protocol):
    """Chi-square of a data set, with the priors of the parameters; `candidate_fit.Fitter` is one.

    far: largest defect (m) of a trajectory that counts as converged.
    """

    far: float

    def box(self, space: ParameterSpace) -> tuple[Tensor, Tensor, Tensor]: ...

    def normal(
        self, space: ParameterSpace, theta: Tensor, linearised: Linearised, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]: ...

    def white(self, linearised: Linearised) -> tuple[Tensor, Tensor]: ...


class TrajectoryProblem:
    """Half of chi-square as a least-squares problem, in which every point keeps its linearised trajectory."""

    def __init__(self, objective: Objective, engine: Collocation | JointCollocation, levels: Tensor) -> None:
        self.objective, self.engine, self.levels = objective, engine, levels
        self.box = objective.box(engine.space)

    def linearise(self, theta: Tensor, lanes: Tensor) -> Linearisation:
        """The model at the starts theta (L, P)."""
        linearised = self.engine.linearise(theta, self.levels[lanes])
        return self._model(theta, _correct(self.engine, theta, linearised, self.objective.far))

    def follow(self, theta: Tensor, known: Linearisation, step: Tensor) -> Linearisation:
        """The model at theta, a `step` away from `known`. The cost is infinite if the trajectory does not converge."""
        linearised, far = _linearised(known), self.objective.far
        shift = (linearised.slopes * step[:, None, None, :]).sum(-1)
        moved = follow_trajectories(self.engine, theta, linearised.levels + shift, shift, far)
        model = self._model(theta, moved)
        lost = ~(moved.defect <= linearised.defect.clamp(min=far))
        return replace(model, cost=torch.where(lost, torch.inf, model.cost))

    def bend(self, known: Linearisation, trial: Linearisation, step: Tensor) -> Tensor:
        """J'c (L, P) for the second-order change c of the whitened readings along the step; priors are linear."""
        linearised = _linearised(known)
        bend = (
            _linearised(trial).readings - linearised.readings - (linearised.jacobian * step[:, None, None, :]).sum(-1)
        )
        columns = torch.cat([linearised.jacobian, bend.unsqueeze(-1)], dim=-1)
        white = self.objective.white(replace(linearised, jacobian=columns))[1].flatten(1, 2)
        return (white[..., :-1] * white[..., -1:]).sum(1)

    def _model(self, theta: Tensor, linearised: Linearised) -> Linearisation:
        scale = self.box[2]
        cost, descent, curvature = self.objective.normal(self.engine.space, theta, linearised, scale)
        # A parameter that nothing determines stays at its value.
        weakest = 1e-9 * torch.diagonal(curvature, dim1=-2, dim2=-1).amax(-1, keepdim=True) + 1e-12
        curvature = curvature + torch.diag_embed(weakest.expand_as(theta))
        return Linearisation(0.5 * cost, -descent / scale, curvature / (scale * scale.unsqueeze(-1)), linearised)


def _linearised(model: Linearisation) -> Linearised:
    assert isinstance(model.state, Linearised)
    return model.state


def follow_trajectories(
    engine: Collocation | JointCollocation, theta: Tensor, guess: Tensor, shift: Tensor, far: float
) -> Linearised:
    """Linearised trajectories near a guess that is `shift` away from converged ones.

    Slopes are computed only once the guess has been corrected.
    """
    levels, lost = guess, torch.zeros(len(theta), dtype=torch.bool)
    lanes = (shift.abs().amax(dim=(-1, -2)) > LONG * far).nonzero().flatten()
    defect = torch.full((len(theta),), torch.inf, dtype=guess.dtype)
    for _ in range(CORRECTIONS - 1):
        if not len(lanes):
            break
        before = defect[lanes]
        path, moved = engine.corrected(theta[lanes], levels[lanes])
        levels, defect = levels.index_copy(0, lanes, path), defect.index_copy(0, lanes, moved)
        lost[lanes] = _diverged(moved, before, far)
        lanes = lanes[(moved > NEARLY * far) & ~lost[lanes]]
    return _correct(engine, theta, engine.linearise(theta, levels), far, lost)


def _correct(
    engine: Collocation | JointCollocation,
    theta: Tensor,
    linearised: Linearised,
    far: float,
    lost: Tensor | None = None,
) -> Linearised:
    """Correct the lanes whose defect is too large until they converge or diverge."""
    lost = torch.zeros_like(linearised.defect, dtype=torch.bool) if lost is None else lost
    for _ in range(CORRECTIONS):
        lanes = (~lost & (linearised.defect > far)).nonzero().flatten()
        if not len(lanes):
            break
        before = linearised.defect
        linearised = linearised.replaced(lanes, engine.linearise(theta[lanes], linearised.levels[lanes]))
        lost = lost | _diverged(linearised.defect, before, far)
    return linearised


def _diverged(defect: Tensor, before: Tensor, far: float) -> Tensor:
    """Lanes (L,) with a large defect that a correction did not reduce."""
    return ~((defect < LOST * far) | (defect < STALLED * before))
