"""The trials of a block, estimated all at once: search, refinement from coarse to fine steps, and the limits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.diagnosis import UNEXPLAINED_RATIO, sample_noise
from fdi_torch.estimate.evolution import evolve
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.objectives import OBJECTIVES, Objective, Problem, Term, spread_of
from fdi_torch.estimate.refined import CONVERGED, STATUSES, Refined
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.study.plan import Block, Plan
from fdi_torch.study.trials import limits, make_trials

# Residuals within this share of a channel's spread are due to the steps of integration.
STEP_SHARE = 1e-4
# A standard error's worth of the sum of correlations is 1e-8 at an SNR of 50 dB: this is less than a hundredth of it.
CORRELATION_TOLERANCE = 1e-13
# Starts closer than this share of the box are one start.
APART = 0.05


@dataclass(frozen=True)
class Trial:
    """One trial's outcome as it is logged. numbers: arrays over the parameters, or single numbers, SI."""

    number: int
    setting: str
    status: str
    numbers: dict[str, list[float] | float]


def run_block(plan: Plan, block: Block) -> list[Trial]:
    """Every trial of a block, estimated by each estimator that the plan asks for."""
    trials = make_trials(plan, block)
    data = Readings(trials.readings, torch.ones_like(trials.readings))
    fits = Fits(plan, data)
    members = fits.searched(plan.search_seeds(block))
    boxed = fits.searched_again(fits.refined(members), plan, block)
    wanted = plan.method.estimators
    found: dict[str, Tensor] = {"truth": trials.truth}
    status = boxed
    if "boxed" in wanted:
        found |= {"boxed": boxed.theta, "boxed_std": fits.standard_errors(boxed)}
    if "free" in wanted:
        status = fits.unbounded(boxed.theta)
        found |= {"free": status.theta, "free_std": fits.standard_errors(status)}
    if "correlation" in wanted:
        found["correlation"] = fits.unbounded(boxed.theta, "correlation").theta
    if "search" in wanted:
        found["search"] = members[:, 0]
    limit = limits(fits.engines[-1], trials)
    found |= {"bound": limit.bound, "correlation_bound": limit.correlation_bound}
    if "linearised" in wanted:
        found["linearised"] = limit.linearised
    found["rho"] = fits.correlations(boxed.theta)
    return _records(plan, block, found, status)


def run_blocks(plan: Plan, blocks: Iterable[Block]) -> Iterator[list[Trial]]:
    """The blocks one after the other, in this process."""
    for block in blocks:
        yield run_block(plan, block)


def _records(plan: Plan, block: Block, found: dict[str, Tensor], refined: Refined) -> list[Trial]:
    columns = {name: values.tolist() for name, values in found.items()}
    columns["cost"] = refined.cost.tolist()
    columns["iterations"] = [float(n) for n in refined.iterations.tolist()]
    name, statuses = plan.settings[block.setting].name, refined.statuses()
    return [
        Trial(number, name, statuses[i], {key: values[i] for key, values in columns.items()})
        for i, number in enumerate(block.numbers)
    ]


class Fits:
    """The readings of B trials, and the engines at each step, to which estimators are fitted."""

    def __init__(self, plan: Plan, data: Readings) -> None:
        self.method, self.fitting, self.data = plan.method, plan.fitting, data
        self.low, self.high = plan.fitting.space.low(), plan.fitting.space.high()
        self.engines: list[Engine] = [plan.fitting.engines(step)[0] for step in plan.method.steps]

    def searched(self, seeds: Tensor, lanes: Tensor | None = None, again: int = 0) -> Tensor:
        """The best members (B, K, P) of differential evolution for each trial; every second on the other objective.

        What one objective takes for the best basin the other may not: correlation is blind to gain and offset.
        """
        every, method = self.method.search_every, self.method
        data = self.data if lanes is None else self.data.of(lanes)
        thinned = Readings(data.values[:, ::every], data.weight[:, ::every])
        engine = thinned_fitting(self.fitting, every).engines(method.search_step)[0]
        first = OBJECTIVES.index(method.objective)
        problem = Problem(self.fitting.space, [Term(engine, thinned)], OBJECTIVES[(first + again) % len(OBJECTIVES)])
        low, high = (bound.expand(len(seeds), -1) for bound in (self.low, self.high))
        result = evolve(problem.cost, low, high, method.search, seeds)
        return distant(result.population, result.cost, self.high - self.low, method.starts)

    def refined(self, starts: Tensor, lanes: Tensor | None = None) -> Refined:
        """Levenberg-Marquardt within the box from every start (B, K, P), the best of which goes on to finer steps."""
        best = starts
        for engine in self.engines:
            refined = self._refine(engine, best, self.low, self.high, lanes=lanes)
            chosen = refined.best()
            best = chosen.theta[:, None]
        return chosen

    def searched_again(self, fit: Refined, plan: Plan, block: Block) -> Refined:
        """Trials whose residuals stay larger than their noise are searched anew; the better of the two fits is kept."""
        for again in range(1, plan.method.searches):
            lanes = self._unexplained(fit.theta).nonzero()[:, 0]
            if not len(lanes):
                break
            other = self.refined(self.searched(plan.search_seeds(block, again)[lanes], lanes, again), lanes)
            better = other.cost < fit.cost[lanes]
            values = {n: v[better] for n, v in vars(other).items() if v is not None}
            fit = fit.file(lanes[better], **values)
        return fit

    def unbounded(self, theta: Tensor, objective: Objective = "likelihood") -> Refined:
        """Levenberg-Marquardt at the finest steps without a box, from theta (B, P)."""
        everywhere = torch.full_like(self.low, torch.inf)
        settings = self.method.refine
        if objective == "correlation":
            settings = replace(settings, decrease_tolerance=CORRELATION_TOLERANCE)
        refined = self._refine(self.engines[-1], theta[:, None], -everywhere, everywhere, objective, settings)
        return refined.best()

    def standard_errors(self, fit: Refined) -> Tensor:
        """(B, P): from the curvature of the likelihood at the estimate; 0 where a bound holds it."""
        assert fit.curvature is not None
        return certainty(fit.curvature, held=fit.held).std

    def correlations(self, theta: Tensor) -> Tensor:
        """rho of each channel at theta (B, P), (B, C)."""
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

    def _unexplained(self, theta: Tensor) -> Tensor:
        """(B,) bool: residuals larger than the readings' own sample-to-sample noise, in any channel."""
        squares = self.engines[-1].moments(theta[:, None], self.data)[:, 0, :, 1]
        count = self.data.count
        own = torch.stack([sample_noise(v, w) for v, w in zip(self.data.values, self.data.weight, strict=True)])
        allowed = UNEXPLAINED_RATIO * own + STEP_SHARE * (spread_of(self.data) / count).sqrt()
        return ((squares / count).sqrt() > allowed).any(-1)


def thinned_fitting(fitting: Fitting, every: int) -> Fitting:
    """The same with every so manieth sample of its recordings."""
    return replace(fitting, recordings=tuple(r.every(every) for r in fitting.recordings))


def distant(population: Tensor, cost: Tensor, width: Tensor, count: int) -> Tensor:
    """Of each population (B, N, P), best first: the best member and the next best apart from those taken, (B, K, P).

    Where too few are apart, the best is repeated.
    """
    usable = torch.isfinite(cost) & torch.isfinite(population).all(-1)
    taken = [population[:, 0]]
    for _ in range(count - 1):
        near = torch.stack([((population - t[:, None]) / width).abs().amax(-1) <= APART for t in taken]).any(0)
        fits = usable & ~near
        place = fits.to(torch.int8).argmax(-1)
        next_best = population[torch.arange(len(population)), place]
        taken.append(torch.where(fits.any(-1)[:, None], next_best, taken[0]))
    return torch.stack(taken, dim=1)


def is_converged(status: str) -> bool:
    return status == STATUSES[CONVERGED]
