"""Levenberg-Marquardt for a batch of bounded least-squares problems ("lanes") that share nothing but the call.

A lane's cost f(theta) is half a chi-square, or a negative log-likelihood, priors included; it is given with its
gradient g and its Gauss-Newton curvature H. Steps solve (H + damping diag H) step = -g (Marquardt 1963); parameters
that a bound stops are held fast. The damping falls to a fifth with a step that gains what the model predicted, and
rises by 2, 4, 8 ... with steps in a row that do not (Nielsen 1999, "Damping parameter in Marquardt's method").

A lane has converged where its Newton decrement, the decrease g'H^-1 g / 2 that the undamped model predicts over the
free parameters, is below a tolerance: a property of the point, however many steps led there.

Curved valleys, such as C_d (1 - b) = constant, refuse the plain step, which leaves their floor. A problem that knows
how its residuals r bend along a step, c = r(theta + step) - r(theta) - J step, has a refused step tried once more with
its second-order correction -(H + damping diag H)^-1 J'c: the geodesic acceleration of Transtrum and Sethna (2012,
arXiv 1201.5885), its second derivative taken over the whole step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from fdi_torch.estimate.damped_step import Quadratic, Step, bent_step, damped_step, newton_decrement
from fdi_torch.estimate.refined import (
    ABANDONED,
    CONVERGED,
    FAILED,
    MAX_ITERATIONS,
    RUNNING,
    STALLED,
    Refined,
    State,
    flat_box,
    typical_size,
    unfinished,
)

_MOST_DAMPING, _LEAST_DAMPING = 1e14, 1e-12
# Damping falls fast and rises slowly at first ("delayed gratification", Transtrum and Sethna 2012, section 4.1).
_EASED, _FORESEEN = 0.2, 0.25  # factor on a step that gained this share of what the model predicted


@dataclass(frozen=True)
class Linearisation:
    """The cost's quadratic model at a point: cost (L,), gradient (L, P), curvature (L, P, P).

    state: what else the problem asks to be given back with this point.
    """

    cost: Tensor
    gradient: Tensor
    curvature: Tensor
    state: State | None = None

    def finite(self) -> Tensor:
        """(L,) bool."""
        slopes = torch.isfinite(self.gradient).all(-1) & torch.isfinite(self.curvature).all(-1).all(-1)
        return torch.isfinite(self.cost) & slopes

    def __getitem__(self, keep: Tensor) -> Linearisation:
        state = None if self.state is None else self.state.lanes(keep)
        return Linearisation(self.cost[keep], self.gradient[keep], self.curvature[keep], state)

    def replaced(self, which: Tensor, new: Linearisation) -> Linearisation:
        """The same with the lanes at places `which` (int64) as `new` has them, in this order."""
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


class Neighbourhood(Protocol):
    """A problem that reaches a point from a neighbouring one."""

    def follow(self, theta: Tensor, known: Linearisation, step: Tensor) -> Linearisation:
        """The model at theta (L, P), a step (L, P) away from the point whose model is `known`."""

    def bend(self, known: Linearisation, trial: Linearisation, step: Tensor) -> Tensor:
        """J'c (L, P) for c = r(theta + step) - r(theta) - J step, priors included; J as it is in `known`."""


@dataclass(frozen=True)
class Competition:
    """When a lane is given up: it is more than `behind` above the least cost of all lanes, or above `target`, and a
    step gained less than a `share` of that. The first step is free."""

    behind: float
    share: float
    target: float = math.inf


@dataclass(frozen=True)
class RefineSettings:
    """When to stop, and how bold to begin.

    decrease_tolerance: of the Newton decrement, in the cost's unit; cost_share: the same as a share of the cost, where
    that is more. step_tolerance: of an accepted step, as a share of the box's width (of the value itself where there is
    no box). iterations: a guard against endless descents.
    """

    iterations: int = 100
    decrease_tolerance: float = 1e-10
    cost_share: float = 64.0 * torch.finfo(torch.float64).eps  # the cost's rounding
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
    """One iteration, for whoever looks on; all have one leading dimension: the lanes still at work."""

    iteration: int
    lanes: Tensor  # (L,) place in the flattened batch
    theta: Tensor  # (L, P)
    cost: Tensor  # (L,)
    promised: Tensor  # (L,) Newton decrement before the step
    damping: Tensor  # (L,)
    accepted: Tensor  # (L,) bool


@dataclass(frozen=True)
class _Lanes:
    """The lanes still at work, one flat leading dimension L."""

    lanes: Tensor
    theta: Tensor
    low: Tensor
    high: Tensor
    model: Linearisation
    damping: Tensor
    growth: Tensor  # Nielsen's nu
    gained: Tensor  # decrease of the cost by the last step
    missed: Tensor  # decrease that the model predicted of it in vain; infinite where it was accepted
    settled: Tensor  # bool: the last step was below the tolerance
    strained: Tensor  # bool: it was accepted after others had been refused

    def __getitem__(self, keep: Tensor) -> _Lanes:
        if keep.dtype == torch.bool and bool(keep.all()):
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
    neighbourhood: Neighbourhood | None = None,
) -> Refined:
    """Minimises the cost of every lane from `start` (*batch, P) within [low, high], which broadcast.

    `linearise(theta (L, P), lanes (L,))` gives the model at theta for the members `lanes` of the flattened batch; those
    that finish leave. With a neighbourhood only the start is asked of `linearise`. A trial whose model is not finite is
    refused; a start whose model is not finite is "failed".
    """
    settings = settings or RefineSettings()
    theta, low, high = flat_box(start, low, high)
    lanes = _begin(linearise, theta, low, high, settings)
    result = unfinished(theta, lanes.model.state)
    least = math.inf if settings.competition is None else settings.competition.target
    iteration = 0
    while len(lanes.lanes):
        decrement, positive = newton_decrement(lanes.quadratic)
        if settings.competition is not None:
            least = min([least, *lanes.model.cost[lanes.model.finite()].tolist()])
        status = _status(lanes, decrement, positive, iteration, least, settings)
        running = status == RUNNING
        if not bool(running.all()):
            result = _filed(result, lanes[~running], status[~running], decrement[~running], iteration)
        lanes, decrement = lanes[running], decrement[running]
        if not len(lanes.lanes):
            break
        step = damped_step(lanes.quadratic, lanes.damping)
        if neighbourhood is None:
            model = linearise(step.trial, lanes.lanes)
        else:
            step, model = _along_the_valley(neighbourhood, lanes, step)
        lanes, accepted = _advance(lanes, step, model, settings)
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
    growth, endless = torch.full_like(model.cost, 2.0), torch.full_like(model.cost, math.inf)
    no = torch.zeros_like(lanes, dtype=torch.bool)
    return _Lanes(lanes, theta, low, high, model, damping, growth, endless, endless, no, no)


def _filed(result: Refined, done: _Lanes, status: Tensor, decrement: Tensor, iteration: int) -> Refined:
    """The result with lanes that are done."""
    model = done.model
    return result.file(
        done.lanes,
        model.state,
        theta=done.theta,
        cost=model.cost,
        gradient=model.gradient,
        curvature=model.curvature,
        promised=decrement,
        held=done.quadratic.held(),
        status=status,
        iterations=torch.full_like(done.lanes, iteration),
    )


def _status(
    lanes: _Lanes, decrement: Tensor, positive: Tensor, iteration: int, least: float, settings: RefineSettings
) -> Tensor:
    """(L,) place in STATUSES.

    A lane has stalled where even a step that was to gain next to nothing failed, or where what was accepted at last
    after refusals gained next to nothing: at a kink, or for a wrong gradient.
    """
    little = (settings.cost_share * lanes.model.cost.abs()).clamp(min=settings.decrease_tolerance)
    converged = positive & (decrement <= little)
    status = torch.full_like(lanes.lanes, MAX_ITERATIONS if iteration >= settings.iterations else RUNNING)
    if settings.competition is not None and iteration > 1:
        behind = lanes.model.cost - least
        hopeless = (behind > settings.competition.behind) & (lanes.gained < settings.competition.share * behind)
        status = torch.where(hopeless, ABANDONED, status)
    in_vain = (lanes.missed <= little) & (lanes.damping > 1.0)  # with less damping the box may be what was in the way
    creeps = lanes.strained & (lanes.gained <= little)
    status = torch.where(in_vain | creeps | (lanes.damping > _MOST_DAMPING), STALLED, status)
    status = torch.where(converged | lanes.settled, CONVERGED, status)
    return torch.where(lanes.model.finite(), status, FAILED)


def _along_the_valley(neighbourhood: Neighbourhood, lanes: _Lanes, step: Step) -> tuple[Step, Linearisation]:
    """The trial of each lane and its model; a refused one is tried once more with its second-order correction."""
    model = neighbourhood.follow(step.trial, lanes.model, step.trial - lanes.theta)
    refused = (step.solvable & (step.predicted > 0) & ~_better(lanes, step, model)).nonzero().flatten()
    if not len(refused):
        return step, model
    some, trial, tried = lanes[refused], step.trial[refused], model[refused]
    bend = neighbourhood.bend(some.model, tried, trial - some.theta)
    bent, is_correction = bent_step(some.quadratic, some.damping, trial, bend)
    is_correction = is_correction & tried.finite()
    if not bool(is_correction.any()):
        return step, model
    bent, refused = bent[is_correction], refused[is_correction]
    again = neighbourhood.follow(bent, tried[is_correction], bent - trial[is_correction])
    return replace(step, trial=step.trial.index_copy(0, refused, bent)), model.replaced(refused, again)


def _better(lanes: _Lanes, step: Step, model: Linearisation) -> Tensor:
    """Which trials (L,) are accepted."""
    return step.solvable & model.finite() & (model.cost < lanes.model.cost) & (step.predicted > 0)


def _advance(lanes: _Lanes, step: Step, model: Linearisation, settings: RefineSettings) -> tuple[_Lanes, Tensor]:
    """Accepts or refuses each lane's trial and updates its damping."""
    accepted = _better(lanes, step, model)
    decrease = torch.where(accepted, lanes.model.cost - model.cost, 0.0)
    foreseen = decrease > _FORESEEN * step.predicted
    change = (step.trial - lanes.theta).abs()
    tiny = (change <= settings.step_tolerance * typical_size(lanes.theta, lanes.low, lanes.high)).all(-1)
    kept = replace(
        lanes,
        theta=torch.where(accepted[:, None], step.trial, lanes.theta),
        model=lanes.model.replaced(accepted.nonzero().flatten(), model[accepted]),
        damping=(lanes.damping * torch.where(accepted & foreseen, _EASED, lanes.growth)).clamp(min=_LEAST_DAMPING),
        growth=torch.where(accepted, 2.0, 2.0 * lanes.growth),
        gained=decrease,
        missed=torch.where(accepted, math.inf, step.predicted),
        settled=accepted & tiny & (lanes.damping <= 1.0),
        strained=accepted & (lanes.growth > 2.0),
    )
    return kept, accepted
