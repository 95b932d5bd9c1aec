"""Levenberg-Marquardt for a batch of independent, bounded least-squares problems ("lanes").

The cost f(theta) of a lane is half a chi-square or a negative log-likelihood, priors included. It comes with its
gradient g and its Gauss-Newton curvature H. A step solves

    (H + damping diag H) step = -g                                                             (Marquardt 1963)

over the free parameters; a parameter at an active bound is held. A step that achieves more than a quarter of the
predicted decrease reduces the damping to a fifth. Any other step multiplies it by nu, where nu is 2 initially, doubles
with each refused step and returns to 2 with an accepted one (Nielsen 1999, "Damping parameter in Marquardt's method").

A lane has converged when its Newton decrement g'H^-1 g / 2, the decrease that the undamped model predicts over the free
parameters, is below a tolerance. This criterion depends on the point only, not on the steps that led there.

In a curved valley, such as C_d (1 - b) = constant, a plain step leaves the valley floor and is refused. If the problem
can compute the nonlinearity of its residuals r along a step, c = r(theta + step) - r(theta) - J step, the refused step
is tried once more with the second-order correction -(H + damping diag H)^-1 J'c. This is the geodesic acceleration of
Transtrum and Sethna (2012, arXiv 1201.5885) with a finite difference over the whole step as second derivative.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.damped_step import Quadratic, Step, damped_step, newton_decrement, second_order_step
from fdi_torch.estimate.linearisation import (
    ABANDONED,
    CONVERGED,
    FAILED,
    MAX_ITERATIONS,
    RUNNING,
    STALLED,
    AnyTrial,
    Linearisation,
    Linearise,
    Neighbourhood,
    Refined,
    are_all_lanes,
    flat_box,
    typical_size,
    unfinished,
)

_MOST_DAMPING, _LEAST_DAMPING = 1e14, 1e-12
# The damping is multiplied by the first number if actual decrease / predicted decrease exceeds the second. It falls
# fast and rises slowly at first ("delayed gratification", Transtrum and Sethna 2012, section 4.1).
_DAMPING_REDUCTION, _GOOD_GAIN_RATIO = 0.2, 0.25


@dataclass(frozen=True)
class Competition:
    """Rule that abandons hopeless lanes.

    The reference is the lowest cost of all lanes or `target`, whichever is less. A lane is abandoned if its cost
    exceeds the reference by more than `behind`, its last accepted step reduced this excess by less than the fraction
    `share`, and its quadratic model does not reach the reference either. The rule applies from the second step on. A
    refused or strongly damped step says nothing about what a lane can gain.
    """

    behind: float
    share: float
    target: float = math.inf


@dataclass(frozen=True)
class RefineSettings:
    """Stopping criteria and initial damping.

    A lane has converged if its Newton decrement is below max(decrease_tolerance, cost_share * |cost|), or if an
    accepted step is below step_tolerance in every parameter, relative to the box's width (to the value itself without
    a box). damping: initial damping.
    iterations: maximum number of iterations. competition: rule for abandoning lanes; None abandons none.
    """

    iterations: int = 100
    decrease_tolerance: float = 1e-10
    cost_share: float = 64.0 * torch.finfo(torch.float64).eps  # rounding of the cost
    step_tolerance: float = 1e-11
    damping: float = 1e-3
    competition: Competition | None = None

    def __post_init__(self) -> None:
        if (
            self.iterations < 0
            or not self.damping > 0
            or min(self.decrease_tolerance, self.cost_share, self.step_tolerance) < 0
        ):
            raise ValueError(f"expected iterations >= 0, damping > 0 and tolerances >= 0, got {self}; change them")


@dataclass(frozen=True)
class Progress:
    """State after one iteration, for a callback. The leading dimension L counts the lanes that are still iterating."""

    iteration: int
    lanes: Tensor  # (L,) index in the flattened batch
    theta: Tensor  # (L, P)
    cost: Tensor  # (L,)
    newton_decrement: Tensor  # (L,) Newton decrement before the step
    damping: Tensor  # (L,)
    accepted: Tensor  # (L,) bool


@dataclass(frozen=True)
class _Lanes:
    """The lanes that are still iterating, one flat leading dimension L."""

    lanes: Tensor
    theta: Tensor
    low: Tensor
    high: Tensor
    model: Linearisation
    damping: Tensor
    growth: Tensor  # Nielsen's nu: factor on the damping after an unsatisfactory step
    actual_decrease: Tensor  # actual decrease of the cost by the last accepted step, infinite before
    refused_decrease: Tensor  # predicted decrease of the last step if it was refused, else infinite
    negligible_step: Tensor  # bool: the last step was accepted and below the step tolerance
    after_refusals: Tensor  # bool: the last step was accepted after refusals

    def __getitem__(self, keep: Tensor) -> _Lanes:
        if are_all_lanes(keep, len(self.lanes)):
            return self
        return _Lanes(*(value[keep] for value in vars(self).values()))

    @property
    def quadratic(self) -> Quadratic:
        return Quadratic(self.theta, self.model.gradient, self.model.curvature, self.low, self.high)


def levenberg_marquardt(
    linearise: Linearise,
    start: Tensor,
    low: Tensor,
    high: Tensor,
    settings: RefineSettings | None = None,
    on_iteration: Callable[[Progress], None] | None = None,
    neighbourhood: Neighbourhood[AnyTrial] | None = None,
) -> Refined:
    """Minimise the cost of every lane from `start` (*batch, P) within [low, high], which broadcast against it.

    `linearise(theta (L, P), lanes (L,))` returns the model at theta; `lanes` are indices into the flattened batch.
    Finished lanes drop out of later calls. With a neighbourhood, `linearise` computes the starting point only and
    the neighbourhood all further ones. A trial whose model is not finite is refused; a lane whose start is not
    finite has the status "failed". Raises ValueError for an empty box and for models of the wrong shape.
    """
    settings = settings or RefineSettings()
    theta, low, high = flat_box(start, low, high)
    lanes = _begin(linearise, theta, low, high, settings)
    result = unfinished(theta, lanes.model.state)
    lowest_cost = math.inf if settings.competition is None else settings.competition.target
    iteration = 0
    while len(lanes.lanes):
        decrement, positive = newton_decrement(lanes.quadratic)
        if settings.competition is not None:
            lowest_cost = min([lowest_cost, *lanes.model.cost[lanes.model.finite()].tolist()])
        status = _status(lanes, decrement, positive, iteration, lowest_cost, settings)
        running = status == RUNNING
        if not bool(running.all()):
            result = _filed(result, lanes[~running], status[~running], decrement[~running], iteration)
        lanes, decrement = lanes[running], decrement[running]
        if not len(lanes.lanes):
            break
        step = damped_step(lanes.quadratic, lanes.damping)
        if neighbourhood is None:
            hopeful, model = torch.arange(len(lanes.lanes), device=theta.device), linearise(step.trial, lanes.lanes)
        else:
            step, hopeful, model = _try_with_correction(neighbourhood, lanes, step)
        lanes, accepted = _advance(lanes, step, hopeful, model, settings)
        iteration += 1
        if on_iteration is not None:
            values = (lanes.lanes, lanes.theta, lanes.model.cost, decrement, lanes.damping, accepted)
            on_iteration(Progress(iteration, *values))
    return result.unflatten(start.shape[:-1])


def _begin(linearise: Linearise, theta: Tensor, low: Tensor, high: Tensor, settings: RefineSettings) -> _Lanes:
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
    nu, infinite = torch.full_like(model.cost, 2.0), torch.full_like(model.cost, math.inf)
    false = torch.zeros_like(lanes, dtype=torch.bool)
    return _Lanes(lanes, theta, low, high, model, damping, nu, infinite, infinite, false, false)


def _filed(result: Refined, finished: _Lanes, status: Tensor, decrement: Tensor, iteration: int) -> Refined:
    """Copy finished lanes into the result."""
    model = finished.model
    return result.file(
        finished.lanes,
        model.state,
        theta=finished.theta,
        cost=model.cost,
        gradient=model.gradient,
        curvature=model.curvature,
        newton_decrement=decrement,
        held=finished.quadratic.held(),
        status=status,
        iterations=torch.full_like(finished.lanes, iteration),
    )


def _status(
    lanes: _Lanes, decrement: Tensor, positive: Tensor, iteration: int, lowest_cost: float, settings: RefineSettings
) -> Tensor:
    """Status code of each lane, (L,), an index into STATUSES.

    A lane has stalled if a step with a negligible predicted decrease was refused, or if a step that was accepted after
    refusals achieved a negligible decrease. This happens at a kink of the cost or with a wrong gradient.
    """
    tolerance = (settings.cost_share * lanes.model.cost.abs()).clamp(min=settings.decrease_tolerance)
    converged = positive & (decrement <= tolerance)
    status = torch.full_like(lanes.lanes, MAX_ITERATIONS if iteration >= settings.iterations else RUNNING)
    if settings.competition is not None and iteration > 1:
        excess = lanes.model.cost - lowest_cost
        slow = lanes.actual_decrease < settings.competition.share * excess
        hopeless = (excess > settings.competition.behind) & slow & (decrement < excess)
        status = torch.where(hopeless, ABANDONED, status)
    # With less damping, a negligible prediction may also be due to a bound that shortened the step.
    no_gain = (lanes.refused_decrease <= tolerance) & (lanes.damping > 1.0)
    negligible_gain = lanes.after_refusals & (lanes.actual_decrease <= tolerance)
    status = torch.where(no_gain | negligible_gain | (lanes.damping > _MOST_DAMPING), STALLED, status)
    status = torch.where(converged | lanes.negligible_step, CONVERGED, status)
    return torch.where(lanes.model.finite(), status, FAILED)


def _try_with_correction(
    neighbourhood: Neighbourhood[AnyTrial], lanes: _Lanes, step: Step
) -> tuple[Step, Tensor, Linearisation]:
    """The steps, the lanes whose trial has a lower cost, (N,), and the models there.

    A trial that would be refused is replaced by its second-order correction, if that is valid (`second_order_step`).
    """
    trial = neighbourhood.attempt(step.trial, lanes.model, step.trial - lanes.theta)
    lower = _lower(lanes.model.cost, step, trial.cost)
    refused = (step.solvable & (step.predicted > 0) & ~lower).nonzero().flatten()
    if len(refused):
        point, known, refused_trial = step.trial[refused], lanes[refused], trial[refused]
        nonlinearity = neighbourhood.nonlinearity(known.model, refused_trial, point - known.theta)
        corrected, valid = second_order_step(known.quadratic, known.damping, point, nonlinearity)
        valid = (valid & torch.isfinite(refused_trial.cost)).nonzero().flatten()
        if len(valid):
            corrected, refused = corrected[valid], refused[valid]
            new = neighbourhood.attempt(corrected, known[valid].model, corrected - point[valid], refused_trial[valid])
            trial = trial.replaced(refused, new)
            step = replace(step, trial=step.trial.index_copy(0, refused, corrected))
            lower = _lower(lanes.model.cost, step, trial.cost)
    hopeful = lower.nonzero().flatten()
    if not len(hopeful):
        return step, hopeful, lanes.model[hopeful]
    return step, hopeful, neighbourhood.model(step.trial[hopeful], trial[hopeful])


def _lower(before: Tensor, step: Step, cost: Tensor) -> Tensor:
    """(L,) bool: the step was solvable, its predicted decrease is positive, and the new cost is finite and lower."""
    return step.solvable & torch.isfinite(cost) & (cost < before) & (step.predicted > 0)


def _advance(
    lanes: _Lanes, step: Step, hopeful: Tensor, model: Linearisation, settings: RefineSettings
) -> tuple[_Lanes, Tensor]:
    """Accept or refuse the trial of each lane and update its damping; also returns which were accepted, (L,) bool.

    model: at the trials of the lanes `hopeful`; the trials of all others are refused.
    """
    better = model.finite() & _lower(lanes.model.cost[hopeful], step[hopeful], model.cost)
    accepted = torch.zeros_like(step.solvable).index_copy(0, hopeful, better)
    decrease = torch.zeros_like(lanes.damping).index_copy(0, hopeful, lanes.model.cost[hopeful] - model.cost)
    decrease = torch.where(accepted, decrease, 0.0)
    well_predicted = decrease > _GOOD_GAIN_RATIO * step.predicted
    factor = torch.where(accepted & well_predicted, _DAMPING_REDUCTION, lanes.growth)
    change = (step.trial - lanes.theta).abs()
    below_tolerance = (change <= settings.step_tolerance * typical_size(lanes.theta, lanes.low, lanes.high)).all(-1)
    advanced = replace(
        lanes,
        theta=torch.where(accepted[:, None], step.trial, lanes.theta),
        model=lanes.model.replaced(hopeful[better], model[better]),
        damping=(lanes.damping * factor).clamp(min=_LEAST_DAMPING),
        growth=torch.where(accepted, 2.0, 2.0 * lanes.growth),
        actual_decrease=torch.where(accepted, decrease, lanes.actual_decrease),
        refused_decrease=torch.where(accepted, math.inf, step.predicted),
        negligible_step=accepted & below_tolerance & (lanes.damping <= 1.0),
        after_refusals=accepted & (lanes.growth > 2.0),
    )
    return advanced, accepted
