"""Hybrid parameter estimation: differential evolution finds the basin, Levenberg-Marquardt refines the optimum.

The search simulates with a coarse integration step, the refinement with a fine one. Unless a step is prescribed, the
refinement halves it until estimates and standard errors no longer depend on it.
"""

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

# A stalled refinement counts as converged if the predicted distance to the optimum is below this, in standard errors.
CONVERGED_WITHIN = 0.1
# In units of the plant's time scale: the shortest integration step (below it, standard errors change less than any
# recording can resolve), and the longest step of the first probing simulation.
FINEST_STEP, FIRST_STEP = 0.01, 5.0
# Tolerances of the search with a slow engine: it only has to reach the basin of attraction of the refinement.
SLOW_PARAMETER_TOLERANCE, SLOW_COST_TOLERANCE, SLOW_SEARCH_TOLERANCE = 0.2, 1e-2, 0.1
# Accuracies of the adaptive solver, loose then tight, as equivalent fixed steps in units of the plant's time scale.
ADAPTIVE_STEPS = (2.0, 0.05)
# Newton decrements at which a refinement stops: in an intermediate stage, and in the last one.
LOOSE_DECREASE, TIGHT_DECREASE = 1e-2, 1e-4
# Tanks are stable, so integration errors do not accumulate: the first samples of a long recording show their size.
PROBE_SAMPLES = 20_000


@dataclass(frozen=True)
class HybridSettings:
    """Settings of search and refinement.

    objectives: objective of the search, objective of the refinement.
    method: 'lm' refines by Levenberg-Marquardt; 'none' takes the best member of the search as the estimate.
    search_step, refine_step: integration steps in s; None chooses them from the measured integration error.
    search_tolerance, refine_tolerance: admissible integration error, as a fraction of the standard deviation of each
    channel's readings over the search box.
    starts: number of good, mutually distant members of the final population that are refined.
    std_tolerance: admissible relative change of the standard errors when the refinement step is halved.
    confidence: confidence level of the diagnosis. adaptive: refine with an adaptive solver instead of fixed steps.
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
    """The estimate, its diagnosis, and how it was computed.

    likelihood: negative log-likelihood behind the standard errors, with the noise levels of the estimate.
    correlation (C,): between readings and predictions of the first recording, per channel.
    predicted: readings (S, C) of each recording, simulated at the estimate, SI units.
    steps: integration steps of search and refinement, s. engine: name of the simulation engine.
    """

    estimate: Estimate
    diagnosis: Diagnosis
    search: EvolutionResult
    refinement: Refined
    likelihood: Problem
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
    """Estimate the parameters of a fitting problem and their standard errors.

    The result is bit-for-bit reproducible for a given seed. on_generation is called after each generation of the
    search, on_iteration after each iteration of the refinement. resume: a `Search` that on_generation received; the
    search continues from it and ends as the uninterrupted one would.
    """
    settings = settings or HybridSettings()
    settings = sparing(settings) if fitting.is_slow else settings
    low, high = search_box(fitting)
    coarse, fine = pick_steps(fitting, settings, low, high)
    result = search(fitting.problem(coarse, settings.objectives[0]), low, high, settings, seed, on_generation, resume)
    starts = distant_members(result, low, high, settings.starts)
    if settings.method == "none":
        refinement = unrefined(fitting, settings, starts, low, high, fine)
    elif settings.adaptive:
        refinement = refine_adaptively(fitting, settings, starts, low, high, coarse, on_iteration)
    else:
        refinement, fine = refine_to_convergence(fitting, settings, starts, low, high, fine, on_iteration)
    return conclude(fitting, settings, result, refinement, (coarse, fine))


def sparing(settings: HybridSettings) -> HybridSettings:
    """Reduce the effort for an engine that evaluates every integration step in Python.

    The search gets larger tolerances. The refinement uses an adaptive solver unless a step is prescribed.
    """
    search = replace(
        settings.search,
        parameter_tolerance=max(settings.search.parameter_tolerance, SLOW_PARAMETER_TOLERANCE),
        cost_tolerance=max(settings.search.cost_tolerance, SLOW_COST_TOLERANCE),
    )
    rough = max(settings.search_tolerance, SLOW_SEARCH_TOLERANCE)
    return replace(settings, search=search, search_tolerance=rough, adaptive=settings.refine_step is None)


def search_box(fitting: Fitting) -> tuple[Tensor, Tensor]:
    """Bounds low, high (P,) of the search: each parameter's range, cut to four prior standard deviations about nominal.

    Raises ValueError for an infinite or empty range.
    """
    space = fitting.space
    nominal, half_range = space.nominal(), 4.0 * space.std()
    low, high = torch.maximum(space.low(), nominal - half_range), torch.minimum(space.high(), nominal + half_range)
    for p, a, b in zip(space, low.tolist(), high.tolist(), strict=True):
        if not (torch.isfinite(torch.tensor([a, b])).all() and a < b):
            raise ValueError(
                f"{p.name}: expected a finite range to search, got [{a:g}, {b:g}] {p.unit}; give low and high"
            )
    return low, high


def pick_steps(fitting: Fitting, settings: HybridSettings, low: Tensor, high: Tensor) -> tuple[float, float]:
    """Integration steps (s) of search and refinement.

    Prescribed steps are taken as given. Otherwise this is the longest step whose integration error, probed at points of
    the box from low (P,) to high (P,), is within the tolerance.
    """
    points = probe_points(low, high)
    spans = [float(r.time[-1] - r.time[0]) for r in fitting.recordings]
    longest, scale = max(min(spans) / 20.0, 1e-6), time_scale(fitting.plant)
    shortest = min(range(len(spans)), key=spans.__getitem__)
    beginning = fitting.beginning(PROBE_SAMPLES)

    def engine_at(step: float) -> Engine:
        return beginning.engines(step)[shortest]

    columns = fitting.columns[shortest]
    recording_points = points[:, columns]
    coarse = settings.search_step
    readings = engine_at(min(longest, FIRST_STEP * scale)).readings(recording_points)
    std = readings.flatten(0, 1).std(dim=0).clamp(min=1e-12)
    if coarse is None:
        coarse = choose_step(engine_at, recording_points, settings.search_tolerance * std, longest, scale, 0.9)
    fine = ADAPTIVE_STEPS[-1] * scale if settings.adaptive else settings.refine_step
    if fine is None:
        fine = choose_step(engine_at, recording_points, settings.refine_tolerance * std, coarse, scale, 0.9)
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
    """Differential evolution on one problem in the box from low (P,) to high (P,), started afresh or resumed."""
    low, high = low.unsqueeze(0), high.unsqueeze(0)
    return evolve(problem.cost, low, high, settings.search, seed, on_generation=on_generation, resume=resume)


def distant_members(search_result: EvolutionResult, low: Tensor, high: Tensor, count: int) -> Tensor:
    """Starting points (K, P) of the refinement, K <= count, best first.

    A member of the final population is selected if, in at least one parameter, it differs from every better selected
    one by more than 5 % of the box's width.
    """
    population = search_result.population[0]
    members = population[torch.isfinite(search_result.cost[0]) & torch.isfinite(population).all(-1)]
    selected = [search_result.best[0]]
    for member in members:
        if len(selected) == count:
            break
        is_distant = [float(((member - t) / (high - low)).abs().max()) > 0.05 for t in selected]
        if all(is_distant):
            selected.append(member)
    return torch.stack(selected)


def refine_to_convergence(
    fitting: Fitting,
    settings: HybridSettings,
    starts: Tensor,
    low: Tensor,
    high: Tensor,
    step: float,
    on_iteration: Callable[[Progress], None] | None,
) -> tuple[Refined, float]:
    """Refine from every start (K, P), take the best optimum, and halve the integration step (s) until it converges.

    The step has converged when halving it changes every standard error by at most the fraction `std_tolerance` and
    every value by at most 5 % of its standard error. Returns the optimum and the last step.
    """

    def run(theta: Tensor, at: float) -> Refined:
        linearise = fitting.problem(at, settings.objectives[1]).linearise
        stop = near_enough(settings, TIGHT_DECREASE) if fitting.takes_own_steps(at) else settings.refine
        return best_of(levenberg_marquardt(linearise, theta, low, high, stop, on_iteration))

    refinement = run(starts, step)
    while settings.refine_step is None and step > 2.0 * FINEST_STEP * time_scale(fitting.plant):
        finer = run(refinement.theta, 0.5 * step)
        coarse_std = information_std(fitting.problem(step, "likelihood"), refinement.theta)
        fine_std = information_std(fitting.problem(0.5 * step, "likelihood"), finer.theta)
        determined = torch.isfinite(coarse_std) & torch.isfinite(fine_std)
        std_change = ((fine_std - coarse_std).abs() / fine_std)[determined]
        value_change = ((finer.theta - refinement.theta).abs()[0] / fine_std)[determined]
        refinement, step = finer, 0.5 * step
        if not bool((std_change > settings.std_tolerance).any() or (value_change > 0.05).any()):
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
    """Refine from every start (K, P) with coarse fixed steps (s), then from the best one with an adaptive solver.

    The adaptive solver runs twice, first with a loose and then with a tight tolerance.
    """

    def run(problem: Problem, theta: Tensor, decrease: float) -> Refined:
        stop = near_enough(settings, decrease)
        return best_of(levenberg_marquardt(problem.linearise, theta, low, high, stop, on_iteration))

    refinement = run(fitting.problem(coarse, settings.objectives[1]), starts, LOOSE_DECREASE)
    scale = time_scale(fitting.plant)
    for step in ADAPTIVE_STEPS:
        problem = fitting.problem(step * scale, settings.objectives[1], adaptive=True)
        refinement = run(problem, refinement.theta, TIGHT_DECREASE if step == ADAPTIVE_STEPS[-1] else LOOSE_DECREASE)
    return refinement


def unrefined(
    fitting: Fitting, settings: HybridSettings, starts: Tensor, low: Tensor, high: Tensor, step: float
) -> Refined:
    """The first of the starts (K, P), unchanged, with the gradient and curvature of the cost there; `step` in s."""
    problem = fitting.problem(step, settings.objectives[1], settings.adaptive)
    return levenberg_marquardt(problem.linearise, starts[:1], low, high, replace(settings.refine, iterations=0))


def near_enough(settings: HybridSettings, decrease: float) -> RefineSettings:
    """Settings that stop the refinement as soon as the Newton decrement is below `decrease`.

    For a negative log-likelihood the decrement is d^2 / 2 with d the distance to the optimum in standard errors.
    """
    return replace(settings.refine, decrease_tolerance=max(settings.refine.decrease_tolerance, decrease))


def best_of(refined: Refined) -> Refined:
    """The member of lowest cost of a flat batch, as a batch of one; members whose cost is not finite rank last."""
    cost = torch.where(torch.isfinite(refined.cost), refined.cost, torch.inf)
    return refined.member(int(cost.argmin()))


def status_of(refinement: Refined) -> str:
    """Status of a batch of one.

    A member that stalled, or that was not iterated at all, counts as 'converged' if its Newton decrement places it
    within `CONVERGED_WITHIN` standard errors of the optimum. Otherwise a member without iterations is 'not refined'.
    """
    status = refinement.statuses()[0]
    near_optimum = float(refinement.promised[0]) < 0.5 * CONVERGED_WITHIN**2
    no_iterations = status == "max_iterations" and not int(refinement.iterations[0])
    if (status == "stalled" or no_iterations) and near_optimum:
        return "converged"
    return "not refined" if no_iterations else status


def information_std(problem: Problem, theta: Tensor) -> Tensor:
    """Standard errors (P,) from the Gauss-Newton curvature at theta (1, P); infinite for undetermined parameters."""
    curvature = problem.linearise(theta, torch.zeros(1, dtype=torch.int64)).curvature[0]
    return make_estimate(problem.space, theta[0], curvature).std


def conclude(
    fitting: Fitting,
    settings: HybridSettings,
    search_result: EvolutionResult,
    refinement: Refined,
    steps: tuple[float, float],
) -> HybridResult:
    """Compute estimate, diagnosis and goodness of fit at the refined optimum.

    Standard errors use each channel's noise level times sqrt((1 + a) / (1 - a)), with a the lag-1 correlation of the
    residuals (see `lasting`), because correlated residuals carry less information than independent ones.
    """
    theta = refinement.theta
    lanes = torch.zeros(1, dtype=torch.int64)
    problem = fitting.problem(steps[1], "likelihood", settings.adaptive)
    noise = problem.noise(theta, lanes)
    predicted, noise_ratios, inflated_noise = [], [], []
    for term, noise_level in zip(problem.terms, noise, strict=True):
        predicted.append(term.engine.readings(term.theta(theta))[0])
        sensor_noise = sample_noise(term.data.known, term.data.weight)
        noise_ratios.append(float((noise_level[0] / sensor_noise.clamp(min=1e-12)).max()))
        inflated_noise.append(noise_level[0] * torch.sqrt(lasting(term.data.known - predicted[-1], term.data.weight)))
    likelihood = problem.at_noise(inflated_noise)
    curvature = likelihood.linearise(theta, lanes).curvature[0]
    estimate = make_estimate(
        fitting.space,
        theta[0],
        curvature,
        status=status_of(refinement),
        noise_std=noise[0][0],
        reached={"search": search_result.reasons()[0], "refinement": refinement.statuses()[0], "steps_s": list(steps)},
    )
    first = problem.terms[0]
    levels = first.engine.levels(first.theta(theta))[0].mean(dim=0)
    channels = [fitting.recordings[0].input_names.index(c) for c in fitting.plant.channels()]
    means = fitting.recordings[0].inputs[:, channels].mean(dim=0)
    diagnosis = diagnose(
        fitting.networks[0],
        fitting.space,
        theta[0],
        estimate.std,
        levels,
        means,
        max(noise_ratios),
        settings.confidence,
    )
    return HybridResult(
        estimate=estimate,
        diagnosis=diagnosis,
        search=search_result,
        refinement=refinement,
        likelihood=likelihood,
        correlation=problem.correlations(theta.unsqueeze(1), lanes)[0, 0],
        predicted=tuple(predicted),
        steps=steps,
        engine=problem.terms[0].engine.why or problem.terms[0].engine.name,
    )
