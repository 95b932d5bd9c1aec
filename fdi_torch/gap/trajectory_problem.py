"""Least squares over the parameters of a simulated plant: the problem that Levenberg-Marquardt solves."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Protocol

import torch
from torch import Tensor

from fdi_torch.estimate.damped_step import Quadratic, newton_decrement
from fdi_torch.estimate.evidence import TOLERANCE
from fdi_torch.estimate.levenberg_marquardt import Competition, RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import ABANDONED, Linearisation, are_all_lanes
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.linearised import Linearised

# A descent ends if a further step is predicted to gain less than this share of the chi-square per reading, or of one if
# that is more. Parameters are then within a tenth of a standard error, misfit included.
DECREMENT = 0.01
MAX_EVALUATIONS = 200  # a guard against descents without an end
# A start is given up if its chi-square exceeds that of the best other fit by GIVE_UP_DEFICIT, and one step reduces this
# deficit by less than GIVE_UP_SHARE of it.
GIVE_UP_DEFICIT, GIVE_UP_SHARE = 30.0, 0.25


def first_lowest(cost: Tensor) -> int:
    """Index of the first of the costs (L,) that exceed the lowest by less than a converged descent may.

    Several starts may end at the same cost but at other parameters, for example if an effect shows nowhere in the
    recording. The lowest cost of all would then be a matter of rounding errors.
    """
    cost = cost.nan_to_num(nan=torch.inf)
    return int((cost <= cost.min() + DECREMENT).nonzero()[0])


class Objective(Protocol):
    """Chi-square of a data set, with the priors of the parameters; `candidate_fit.Fitter` is one."""

    def __hash__(self) -> int: ...

    def box(self, space: ParameterSpace) -> tuple[Tensor, Tensor, Tensor]: ...

    def priors(self, space: ParameterSpace, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]: ...

    def chi_square(self, space: ParameterSpace, theta: Tensor, residual: Tensor) -> Tensor: ...

    def residual(self, readings: Tensor) -> Tensor: ...

    def normal(
        self, space: ParameterSpace, theta: Tensor, residual: Tensor, jacobian: Tensor, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]: ...

    def white(self, linearised: Linearised) -> tuple[Tensor, Tensor]: ...

    def whiten(self, x: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class FittedTrajectory:
    """Linearised trajectories of L lanes, with their whitened Jacobians (L, S, C, P)."""

    linearised: Linearised
    jacobian: Tensor

    def lanes(self, which: Tensor) -> FittedTrajectory:
        """Select lanes by index (int64) or mask (bool)."""
        return FittedTrajectory(self.linearised.lanes(which), self.jacobian[which])

    def replaced(self, which: Tensor, new: FittedTrajectory) -> FittedTrajectory:
        """A copy in which the k-th lane of `new` replaces lane `which[k]` (int64)."""
        linearised = self.linearised.replaced(which, new.linearised)
        return FittedTrajectory(linearised, self.jacobian.index_copy(0, which, new.jacobian))


@dataclass(frozen=True)
class TrialTrajectory:
    """A trajectory without derivatives: cost (L,), levels (L, K+1, n), readings (L, S, C)."""

    cost: Tensor
    levels: Tensor
    readings: Tensor

    def __getitem__(self, keep: Tensor) -> TrialTrajectory:
        if are_all_lanes(keep, len(self.cost)):
            return self
        return TrialTrajectory(self.cost[keep], self.levels[keep], self.readings[keep])

    def replaced(self, which: Tensor, new: TrialTrajectory) -> TrialTrajectory:
        """A copy in which the k-th lane of `new` replaces lane `which[k]` (int64)."""
        pairs = ((getattr(self, f.name), getattr(new, f.name)) for f in fields(self))
        return TrialTrajectory(*(mine.index_copy(0, which, other) for mine, other in pairs))


class Engine(Protocol):
    """Trajectories of a plant and their derivatives; see `Collocation`."""

    space: ParameterSpace

    def linearise(self, theta: Tensor, levels: Tensor) -> Linearised: ...

    def trajectories(self, theta: Tensor, guess: Tensor | None = None) -> Tensor: ...

    def read(self, levels: Tensor, theta: Tensor) -> Tensor: ...


class TrajectoryProblem:
    """Half of chi-square as a least-squares problem, in which every point keeps its linearised trajectory."""

    def __init__(self, objective: Objective, engine: Engine) -> None:
        self.objective, self.engine = objective, engine
        self.box = objective.box(engine.space)

    def linearise(self, theta: Tensor, lanes: Tensor) -> Linearisation:
        """The model at the starts theta (L, P)."""
        return self._model(theta, self.engine.linearise(theta, self.engine.trajectories(theta)))

    def attempt(
        self, theta: Tensor, known: Linearisation, step: Tensor, near: TrialTrajectory | None = None
    ) -> TrialTrajectory:
        """The trajectories at theta, found from those of `near` (otherwise `known`), which lie a `step` away."""
        linearised = _fitted(known).linearised
        guess = (near or linearised).levels + _along(linearised.slopes, step)
        levels = self.engine.trajectories(theta, guess)
        readings = self.engine.read(levels, theta)
        cost = 0.5 * self.objective.chi_square(self.engine.space, theta, self.objective.residual(readings))
        return TrialTrajectory(cost, levels, readings)

    def nonlinearity(self, known: Linearisation, trial: TrialTrajectory, step: Tensor) -> Tensor:
        """J'c (L, P) for the second-order change c of the whitened readings along the step; priors are linear."""
        here = _fitted(known)
        linear = here.linearised.readings + _along(here.linearised.jacobian, step)
        nonlinearity = self.objective.whiten(trial.readings - linear)
        return (here.jacobian.flatten(1, 2).mT @ nonlinearity.flatten(1).unsqueeze(-1)).squeeze(-1)

    def model(self, theta: Tensor, trial: TrialTrajectory) -> Linearisation:
        """Readings and Jacobian at the parameters of a trial step."""
        return self._model(theta, self.engine.linearise(theta, trial.levels))

    def converged(self, theta: Tensor, linearised: Linearised, readings: int) -> Tensor:
        """Whether each lane is at a minimum, (L,) bool. readings: number of valid ones."""
        model, (low, high, _) = self._model(theta, linearised), self.box
        decrement, _ = newton_decrement(Quadratic(theta, model.gradient, model.curvature, low, high))
        return _near_minimum(decrement, 2.0 * model.cost, readings)

    def _model(self, theta: Tensor, linearised: Linearised) -> Linearisation:
        scale = self.box[2]
        residual, jacobian = self.objective.white(linearised)
        cost, descent, curvature = self.objective.normal(self.engine.space, theta, residual, jacobian, scale)
        # A parameter that nothing determines stays at its value.
        weakest = 1e-9 * torch.diagonal(curvature, dim1=-2, dim2=-1).amax(-1, keepdim=True) + 1e-12
        curvature = curvature + torch.diag_embed(weakest.expand_as(theta))
        state = FittedTrajectory(linearised, jacobian)
        return Linearisation(0.5 * cost, -descent / scale, curvature / (scale * scale.unsqueeze(-1)), state)


@dataclass(frozen=True)
class DescentResult:
    """End points of descents: theta (L, P), cost (L,) chi-square, linearised trajectories.

    converged (L,) bool: whether a further step is predicted to gain less log-likelihood than TOLERANCE, times
    chi-square per reading if that exceeds one. Parameters are then within half a standard error. A descent may end
    before DECREMENT because its steps are refused, as near a kink. A start that was given up has not converged.
    """

    theta: Tensor
    cost: Tensor
    linearised: Linearised
    converged: Tensor


def descend(
    problem: TrajectoryProblem,
    theta: Tensor,
    readings: int,
    target: float = math.inf,
    cap: int = MAX_EVALUATIONS,
    decrement: float = DECREMENT,
    box: tuple[Tensor, Tensor] | None = None,
) -> DescentResult:
    """Minimise chi-square from each of the starts theta (L, P).

    readings: number of valid readings. target: chi-square of the best other fit, by which starts are given up
    (GIVE_UP_DEFICIT). cap: maximum number of evaluations. decrement: Newton decrement at which a descent ends, by
    default DECREMENT. box: lower and upper bounds of each start (L, P), by default those of the problem.
    """
    # The optimiser's cost is a negative log-likelihood, half of chi-square.
    competition = Competition(0.5 * GIVE_UP_DEFICIT, GIVE_UP_SHARE, 0.5 * target)
    share = decrement / max(readings, 1)
    settings = RefineSettings(cap, 0.5 * decrement, share, step_tolerance=0.0, competition=competition)
    low, high = box or problem.box[:2]
    minimum = levenberg_marquardt(problem.linearise, theta, low, high, settings, neighbourhood=problem)
    assert isinstance(minimum.state, FittedTrajectory)
    cost = 2.0 * minimum.cost
    converged = _near_minimum(minimum.newton_decrement, cost, readings) & (minimum.status != ABANDONED)
    return DescentResult(minimum.theta, cost, minimum.state.linearised, converged)


def _near_minimum(decrement: Tensor, cost: Tensor, readings: int) -> Tensor:
    """`DescentResult.converged` from Newton decrements and costs, (L,) each, but for starts that were given up."""
    return decrement < TOLERANCE * (cost / max(readings, 1)).clamp(min=1.0)


def _fitted(model: Linearisation) -> FittedTrajectory:
    assert isinstance(model.state, FittedTrajectory)
    return model.state


def _along(slopes: Tensor, step: Tensor) -> Tensor:
    """Change (L, S, C) along a step (L, P), given slopes (L, S, C, P); parameter by parameter, without products of the
    size of all slopes."""
    total = torch.zeros_like(slopes[..., 0])
    for by, change in zip(slopes.unbind(-1), step.unbind(-1), strict=True):
        total.addcmul_(by, change[:, None, None])
    return total
