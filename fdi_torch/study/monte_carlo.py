"""Estimation of all trials of a block at once: search, refinement from coarse to fine steps, and bounds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fdi_torch.device import on_its_device
from fdi_torch.estimate.evolution import distant_members, evolve
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.misfit import UNEXPLAINED_RATIO
from fdi_torch.estimate.objectives import OBJECTIVES, Objective, Problem, Term, spread_of
from fdi_torch.estimate.refined import CONVERGED, STATUSES, Refined
from fdi_torch.sample_noise import sample_noise
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.study.study_plan import Block, Plan
from fdi_torch.study.trial_readings import limits, make_trials

# Residuals within this share of a channel's standard deviation are attributed to the integration steps.
STEP_SHARE = 1e-4
# The sum of correlations has a standard error of 1e-8 at an SNR of 50 dB, a hundred times this tolerance and more.
CORRELATION_TOLERANCE = 1e-13


@dataclass(frozen=True)
class Trial:
    """Result of one trial as logged. numbers: arrays over the parameters, or single numbers, SI."""

    number: int
    setting: str
    status: str
    numbers: dict[str, list[float] | float]


@on_its_device
def run_block(plan: Plan, block: Block) -> list[Trial]:
    """Estimate every trial of a block with each requested estimator."""
    trials = make_trials(plan, block)
    data = Readings(trials.readings, torch.ones_like(trials.readings))
    fits = Fits(plan, data)
    members = fits.searched(plan.search_seeds(block))
    boxed = fits.searched_again(fits.refined(members), plan, block)
    estimators = plan.method.estimators
    results: dict[str, Tensor] = {"truth": trials.truth}
    status = boxed
    if "boxed" in estimators:
        results |= {"boxed": boxed.theta, "boxed_std": fits.standard_errors(boxed)}
    if "free" in estimators:
        status = fits.unbounded(boxed.theta)
        results |= {"free": status.theta, "free_std": fits.standard_errors(status)}
    if "correlation" in estimators:
        results["correlation"] = fits.unbounded(boxed.theta, "correlation").theta
    if "search" in estimators:
        results["search"] = members[:, 0]
    limit = limits(fits.engines[-1], trials)
    results |= {"bound": limit.bound, "correlation_bound": limit.correlation_bound}
    if "linearised" in estimators:
        results["linearised"] = limit.linearised
    results["rho"] = fits.correlations(boxed.theta)
    return _records(plan, block, results, status)


def run_blocks(plan: Plan, blocks: Iterable[Block]) -> Iterator[list[Trial]]:
    """Compute the blocks one after the other in this process."""
    for block in blocks:
        yield run_block(plan, block)


def _records(plan: Plan, block: Block, results: dict[str, Tensor], refined: Refined) -> list[Trial]:
    columns = {name: values.tolist() for name, values in results.items()}
    columns["cost"] = refined.cost.tolist()
    columns["iterations"] = [float(n) for n in refined.iterations.tolist()]
    name, statuses = plan.settings[block.setting].name, refined.statuses()
    return [
        Trial(number, name, statuses[i], {key: values[i] for key, values in columns.items()})
        for i, number in enumerate(block.numbers)
    ]


class Fits:
    """The estimates of B simulated trials from their readings, with one engine for each integration step."""

    def __init__(self, plan: Plan, data: Readings) -> None:
        self.method, self.fitting, self.data = plan.method, plan.fitting, data
        self.low, self.high = plan.fitting.space.low(), plan.fitting.space.high()
        self.engines: list[Engine] = [plan.fitting.engines(step)[0] for step in plan.method.steps]

    def searched(
        self, seeds: Int[Tensor, " B"], lanes: Int[Tensor, " B"] | None = None, again: int = 0
    ) -> Float[Tensor, "B K P"]:
        """The best K parameter vectors of a global search for each trial, far apart from each other.

        Repeated searches alternate between the objectives, because their best basins may differ: the correlation is
        insensitive to gain and offset.
        """
        every, method = self.method.search_every, self.method
        data = self.data if lanes is None else self.data.of(lanes)
        thinned = Readings(data.values[:, ::every], data.weight[:, ::every])
        recordings = tuple(r.every(every) for r in self.fitting.recordings)
        engine = replace(self.fitting, recordings=recordings).engines(method.search_step)[0]
        first = OBJECTIVES.index(method.objective)
        problem = Problem(self.fitting.space, [Term(engine, thinned)], OBJECTIVES[(first + again) % len(OBJECTIVES)])
        low, high = (bound.expand(len(seeds), -1) for bound in (self.low, self.high))
        result = evolve(problem.cost, low, high, method.search, seeds)
        return distant_members(result.population, result.cost, self.high - self.low, method.starts)

    def refined(self, starts: Float[Tensor, "B K P"], lanes: Int[Tensor, " B"] | None = None) -> Refined:
        """Levenberg-Marquardt within the box from every start; the best result continues at finer steps."""
        best = starts
        for engine in self.engines:
            refined = self._refine(engine, best, self.low, self.high, lanes=lanes)
            chosen = refined.best()
            best = chosen.theta[:, None]
        return chosen

    def searched_again(self, fit: Refined, plan: Plan, block: Block) -> Refined:
        """Search again for trials whose residuals are larger than their noise, and keep the better fit."""
        for again in range(1, plan.method.searches):
            lanes = self._unexplained(fit.theta).nonzero()[:, 0]
            if not len(lanes):
                break
            other = self.refined(self.searched(plan.search_seeds(block, again)[lanes], lanes, again), lanes)
            better = other.cost < fit.cost[lanes]
            values = {n: v[better] for n, v in vars(other).items() if v is not None}
            fit = fit.file(lanes[better], **values)
        return fit

    def unbounded(self, theta: Float[Tensor, "B P"], objective: Objective = "likelihood") -> Refined:
        """Levenberg-Marquardt at the finest step without bounds, from theta."""
        everywhere = torch.full_like(self.low, torch.inf)
        settings = self.method.refine
        if objective == "correlation":
            settings = replace(settings, decrease_tolerance=CORRELATION_TOLERANCE)
        refined = self._refine(self.engines[-1], theta[:, None], -everywhere, everywhere, objective, settings)
        return refined.best()

    def standard_errors(self, fit: Refined) -> Float[Tensor, "B P"]:
        """Standard errors from the curvature of the likelihood; 0 where a bound is active."""
        return certainty(fit.curvature, held=fit.held).std

    def correlations(self, theta: Float[Tensor, "B P"]) -> Float[Tensor, "B C"]:
        """Correlation of each channel at theta."""
        problem = Problem(self.fitting.space, [Term(self.engines[-1], self.data)])
        return problem.correlations(theta[:, None], torch.arange(len(theta)))[:, 0]

    def _refine(
        self,
        engine: Engine,
        starts: Tensor,
        low: Tensor,
        high: Tensor,
        objective: Objective = "likelihood",
        settings: RefineSettings | None = None,
        lanes: Tensor | None = None,
    ) -> Refined:
        data = self.data if lanes is None else self.data.of(lanes)
        problem, each = Problem(self.fitting.space, [Term(engine, data)], objective), starts.shape[1]
        return levenberg_marquardt(
            lambda theta, members: problem.linearise(theta, members // each),
            starts,
            low,
            high,
            settings or self.method.refine,
        )

    def _unexplained(self, theta: Float[Tensor, "B P"]) -> Bool[Tensor, " B"]:
        """Whether residuals exceed the sample-to-sample noise in any channel."""
        squares = self.engines[-1].moments(theta[:, None], self.data)[:, 0, :, 1]
        count = self.data.count
        noise = torch.stack([sample_noise(v, w) for v, w in zip(self.data.values, self.data.weight, strict=True)])
        allowed = UNEXPLAINED_RATIO * noise + STEP_SHARE * (spread_of(self.data) / count).sqrt()
        return ((squares / count).sqrt() > allowed).any(-1)


def is_converged(status: str) -> bool:
    return status == STATUSES[CONVERGED]
