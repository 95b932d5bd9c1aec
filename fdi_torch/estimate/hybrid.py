"""The pipeline: a global search on coarse steps, refinement on fine ones, standard errors converged in the step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.estimate.diagnosis import Diagnosis, diagnose, lasting, sample_noise
from fdi_torch.estimate.evolution import EvolutionResult, EvolutionSettings, Search, evolve
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.levenberg_marquardt import Progress, RefineSettings, levenberg_marquardt
from fdi_torch.estimate.objectives import Objective, Problem
from fdi_torch.estimate.refined import Refined
from fdi_torch.estimate.uncertainty import Estimate, make_estimate
from fdi_torch.plant.scales import time_scale
from fdi_torch.simulate.engine import Engine
from fdi_torch.simulate.step_length import choose_step, probe_points

# A refinement that stopped at the last digits of its cost is converged when this few standard errors are left to go.
LEFT_TO_GO = 0.1
# Steps in units of the plant's time scale. Finer ones change no standard error that a recording could support;
# the first of a look round is this long at most.
FINEST_STEP, FIRST_STEP = 0.01, 5.0
# What a slow engine makes do with: a search that ends where refinement can go on, and an adaptive solver for that.
NEAR_SHARE, NEAR_COST, ROUGH_ERROR = 0.2, 1e-2, 0.1
ADAPTIVE_STEPS = (2.0, 0.05)
NEAR_ENOUGH, CLOSE = 1e-2, 1e-4
# Tanks forget, so that errors of the step do not add up: a long recording's beginning tells how large they are.
PROBE_SAMPLES = 20_000


@dataclass(frozen=True)
class HybridSettings:
    """How to estimate.

    objectives: the one searched on and the one refined on. steps in s; None: chosen by measured error.
    search_tolerance, refine_tolerance: that error, as a share of a channel's spread over the box of parameters.
    starts: how many of the search's best, mutually distant members are refined. std_tolerance: standard errors change
    by less than this share when the step is halved. adaptive: refine by an adaptive solver instead of in fixed steps.
    method: Levenberg-Marquardt, or none: the search's best member is the estimate.
    """

    objectives: tuple[Objective, Objective] = ("correlation", "likelihood")
    search: EvolutionSettings = field(default_factory=EvolutionSettings)
    method: Literal["lm", "none"] = "lm"
    refine: RefineSettings = field(default_factory=RefineSettings)
    search_step: float | None = None
    refine_step: float | None = None
    search_tolerance: float = 3e-3
    refine_tolerance: float = 1e-5
    starts: int = 3
    std_tolerance: float = 5e-3
    confidence: float = 0.95
    adaptive: bool = False


@dataclass(frozen=True)
class HybridResult:
    """The estimate and how it was reached. predicted: readings (S, C) of each recording at the estimate, SI."""

    estimate: Estimate
    diagnosis: Diagnosis
    search: EvolutionResult
    refinement: Refined
    correlation: Tensor
    predicted: tuple[Tensor, ...]
    steps: tuple[float, float]
    engine: str


def estimate_parameters(
    fitting: Fitting,
    settings: HybridSettings | None = None,
    seed: int = 0,
    on_generation: Callable[[Search], None] | None = None,
    on_iteration: Callable[[Progress], None] | None = None,
    resume: Search | None = None,
) -> HybridResult:
    """Which parameters explain the recordings best, and how surely. Repeats bit for bit for a seed.

    resume: a state that `on_generation` was given; the search goes on from there to the same end.
    """
    settings = settings or HybridSettings()
    settings = sparing(settings) if fitting.is_slow else settings
    low, high = search_box(fitting)
    coarse, fine = pick_steps(fitting, settings, low, high)
    found = search(fitting.problem(coarse, settings.objectives[0]), low, high, settings, seed, on_generation, resume)
    starts = distant_members(found, low, high, settings.starts)
    if settings.method == "none":
        refinement = unrefined(fitting, settings, starts, low, high, fine)
    elif settings.adaptive:
        refinement = refine_adaptively(fitting, settings, starts, low, high, coarse, on_iteration)
    else:
        refinement, fine = refine_to_convergence(fitting, settings, starts, low, high, fine, on_iteration)
    return conclude(fitting, settings, found, refinement, (coarse, fine))


def sparing(settings: HybridSettings) -> HybridSettings:
    """The same for an engine that pays for every step in Python: a rougher search that ends as soon as its members are
    near each other, and refinement by an adaptive solver where no step was asked for.
    """
    search = replace(
        settings.search,
        parameter_tolerance=max(settings.search.parameter_tolerance, NEAR_SHARE),
        cost_tolerance=max(settings.search.cost_tolerance, NEAR_COST),
    )
    rough = max(settings.search_tolerance, ROUGH_ERROR)
    return replace(settings, search=search, search_tolerance=rough, adaptive=settings.refine_step is None)


def search_box(fitting: Fitting) -> tuple[Tensor, Tensor]:
    """low, high (P,): the parameters' ranges, or four standard deviations of a prior where that is tighter."""
    space = fitting.space
    nominal, reach = space.nominal(), 4.0 * space.std()
    low, high = torch.maximum(space.low(), nominal - reach), torch.minimum(space.high(), nominal + reach)
    for p, a, b in zip(space, low.tolist(), high.tolist(), strict=True):
        if not (torch.isfinite(torch.tensor([a, b])).all() and a < b):
            raise ValueError(
                f"{p.name}: expected a finite range to search, got [{a:g}, {b:g}] {p.unit}; give low and high"
            )
    return low, high


def pick_steps(fitting: Fitting, settings: HybridSettings, low: Tensor, high: Tensor) -> tuple[float, float]:
    """The steps (s) of search and refinement: those asked for, or the longest whose error is small enough over the box
    from low (P,) to high (P,).
    """
    points = probe_points(low, high)
    spans = [float(r.time[-1] - r.time[0]) for r in fitting.recordings]
    longest, scale = max(min(spans) / 20.0, 1e-6), time_scale(fitting.plant)
    shortest = min(range(len(spans)), key=spans.__getitem__)
    beginning = fitting.beginning(PROBE_SAMPLES)

    def engine_at(step: float) -> Engine:
        return beginning.engines(step)[shortest]

    columns = fitting.columns[shortest]
    own_points = points[:, columns]
    coarse = settings.search_step
    readings = engine_at(min(longest, FIRST_STEP * scale)).readings(own_points)
    spread = readings.flatten(0, 1).std(dim=0).clamp(min=1e-12)
    if coarse is None:
        coarse = choose_step(engine_at, own_points, settings.search_tolerance * spread, longest, scale, 0.9)
    fine = ADAPTIVE_STEPS[-1] * scale if settings.adaptive else settings.refine_step
    if fine is None:
        fine = choose_step(engine_at, own_points, settings.refine_tolerance * spread, coarse, scale, 0.9)
    return coarse, fine


def search(
    problem: Problem,
    low: Tensor,
    high: Tensor,
    settings: HybridSettings,
    seed: int,
    on_generation: Callable[[Search], None] | None,
    resume: Search | None = None,
) -> EvolutionResult:
    """Differential evolution on one problem in the box from low (P,) to high (P,), or on from where one stopped."""
    low, high = low.unsqueeze(0), high.unsqueeze(0)
    return evolve(problem.cost, low, high, settings.search, seed, on_generation=on_generation, resume=resume)


def distant_members(found: EvolutionResult, low: Tensor, high: Tensor, count: int) -> Tensor:
    """The best member, and further ones (K, P) that are a twentieth of the box away from every better one taken."""
    population = found.population[0]
    members = population[torch.isfinite(found.cost[0]) & torch.isfinite(population).all(-1)]
    taken = [found.best[0]]
    for member in members:
        if len(taken) == count:
            break
        apart = [float(((member - t) / (high - low)).abs().max()) > 0.05 for t in taken]
        if all(apart):
            taken.append(member)
    return torch.stack(taken)


def refine_to_convergence(
    fitting: Fitting,
    settings: HybridSettings,
    starts: Tensor,
    low: Tensor,
    high: Tensor,
    step: float,
    on_iteration: Callable[[Progress], None] | None,
) -> tuple[Refined, float]:
    """Refines from every start (K, P) in the box from low (P,) to high (P,), takes the best, and halves the step (s)
    until standard errors and values stand still; with the step that it came to.
    """

    def run(theta: Tensor, at: float) -> Refined:
        linearise = fitting.problem(at, settings.objectives[1]).linearise
        stop = near_enough(settings, CLOSE) if fitting.takes_own_steps(at) else settings.refine
        return best_of(levenberg_marquardt(linearise, theta, low, high, stop, on_iteration))

    refinement = run(starts, step)
    while settings.refine_step is None and step > 2.0 * FINEST_STEP * time_scale(fitting.plant):
        finer = run(refinement.theta, 0.5 * step)
        coarse_std = information_std(fitting.problem(step, "likelihood"), refinement.theta)
        fine_std = information_std(fitting.problem(0.5 * step, "likelihood"), finer.theta)
        known = torch.isfinite(coarse_std) & torch.isfinite(fine_std)
        change = ((fine_std - coarse_std).abs() / fine_std)[known]
        move = ((finer.theta - refinement.theta).abs()[0] / fine_std)[known]
        refinement, step = finer, 0.5 * step
        if not bool((change > settings.std_tolerance).any() or (move > 0.05).any()):
            break
    return refinement, step


def refine_adaptively(
    fitting: Fitting,
    settings: HybridSettings,
    starts: Tensor,
    low: Tensor,
    high: Tensor,
    coarse: float,
    on_iteration: Callable[[Progress], None] | None,
) -> Refined:
    """Refines from every start (K, P) in coarse steps (s), and goes on from the best with an adaptive solver, then a
    tight one.
    """

    def run(problem: Problem, theta: Tensor, enough: float) -> Refined:
        stop = near_enough(settings, enough)
        return best_of(levenberg_marquardt(problem.linearise, theta, low, high, stop, on_iteration))

    refinement = run(fitting.problem(coarse, settings.objectives[1]), starts, NEAR_ENOUGH)
    scale = time_scale(fitting.plant)
    for step in ADAPTIVE_STEPS:
        problem = fitting.problem(step * scale, settings.objectives[1], adaptive=True)
        refinement = run(problem, refinement.theta, CLOSE if step == ADAPTIVE_STEPS[-1] else NEAR_ENOUGH)
    return refinement


def unrefined(
    fitting: Fitting, settings: HybridSettings, starts: Tensor, low: Tensor, high: Tensor, step: float
) -> Refined:
    """The first of the starts (K, P) as it is, with the cost's gradient and curvature there, in steps of `step` s."""
    problem = fitting.problem(step, settings.objectives[1], settings.adaptive)
    return levenberg_marquardt(problem.linearise, starts[:1], low, high, replace(settings.refine, iterations=0))


def near_enough(settings: HybridSettings, decrease: float) -> RefineSettings:
    """Stops where the cost would still fall by `decrease`: half the square of the way left, in standard errors."""
    return replace(settings.refine, decrease_tolerance=max(settings.refine.decrease_tolerance, decrease))


def best_of(refined: Refined) -> Refined:
    """The member (1, P) of lowest cost of a flat batch; a cost that is no number never wins."""
    cost = torch.where(torch.isfinite(refined.cost), refined.cost, torch.inf)
    return refined.member(int(cost.argmin()))


def status_of(refinement: Refined) -> str:
    """The status of one member; 'converged' too where only rounding kept it from going the last bit, and where no
    refinement was wanted and none was needed.
    """
    status = refinement.statuses()[0]
    near = float(refinement.promised[0]) < 0.5 * LEFT_TO_GO**2
    unwanted = status == "max_iterations" and not int(refinement.iterations[0])
    if (status == "stalled" or unwanted) and near:
        return "converged"
    return "not refined" if unwanted else status


def information_std(problem: Problem, theta: Tensor) -> Tensor:
    """Standard errors (P,) from the curvature at theta (1, P); infinite where nothing determines a parameter."""
    curvature = problem.linearise(theta, torch.zeros(1, dtype=torch.int64)).curvature[0]
    return make_estimate(problem.space, theta[0], curvature).std


def conclude(
    fitting: Fitting,
    settings: HybridSettings,
    found: EvolutionResult,
    refinement: Refined,
    steps: tuple[float, float],
) -> HybridResult:
    """Estimate, diagnosis and goodness of fit at the refined optimum."""
    theta = refinement.theta
    lanes = torch.zeros(1, dtype=torch.int64)
    problem = fitting.problem(steps[1], "likelihood", settings.adaptive)
    noise = problem.noise(theta, lanes)
    predicted, ratios, slow_noise = [], [], []
    for term, level in zip(problem.terms, noise, strict=True):
        predicted.append(term.engine.readings(term.theta(theta))[0])
        own = sample_noise(term.data.known, term.data.weight)
        ratios.append(float((level[0] / own.clamp(min=1e-12)).max()))
        slow_noise.append(level[0] * torch.sqrt(lasting(term.data.known - predicted[-1], term.data.weight)))
    curvature = problem.at_noise(slow_noise).linearise(theta, lanes).curvature[0]
    result = make_estimate(
        fitting.space,
        theta[0],
        curvature,
        status=status_of(refinement),
        noise_std=noise[0][0],
        reached={"search": found.reasons()[0], "refinement": refinement.statuses()[0], "steps_s": list(steps)},
    )
    first = problem.terms[0]
    levels = first.engine.levels(first.theta(theta))[0].mean(dim=0)
    channels = [fitting.recordings[0].input_names.index(c) for c in fitting.plant.channels()]
    means = fitting.recordings[0].inputs[:, channels].mean(dim=0)
    diagnosis = diagnose(
        fitting.networks[0], fitting.space, theta[0], result.std, levels, means, max(ratios), settings.confidence
    )
    return HybridResult(
        estimate=result,
        diagnosis=diagnosis,
        search=found,
        refinement=refinement,
        correlation=problem.correlations(theta.unsqueeze(1), lanes)[0, 0],
        predicted=tuple(predicted),
        steps=steps,
        engine=problem.terms[0].engine.why or problem.terms[0].engine.name,
    )
