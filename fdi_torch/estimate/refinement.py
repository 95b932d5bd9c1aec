"""Settings of the hybrid estimation, and refinement of the search's best members: integration steps are halved, or an
adaptive solver is used, until estimates and standard errors no longer depend on them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.estimate.evolution import EvolutionResult, EvolutionSettings, distant_members
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import Progress, RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import Refined
from fdi_torch.estimate.objectives import Objective, Problem
from fdi_torch.plant.scales import time_scale

# Tolerances of the search with a slow engine: it only has to reach the basin of attraction of the refinement.
SLOW_PARAMETER_TOLERANCE, SLOW_COST_TOLERANCE, SLOW_SEARCH_TOLERANCE = 0.2, 1e-2, 0.1


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


def with_less_effort(settings: HybridSettings) -> HybridSettings:
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


# A stalled refinement counts as converged if the predicted distance to the optimum is below this, in standard errors.
CONVERGED_WITHIN = 0.1
# The shortest integration step, in units of the plant's time scale: below it, standard errors change less than any
# recording can resolve.
FINEST_STEP = 0.01
# Accuracies of the adaptive solver, loose then tight, as equivalent fixed steps in units of the plant's time scale.
ADAPTIVE_STEPS = (2.0, 0.05)
# Newton decrements at which a refinement stops: in an intermediate stage, and in the last one.
LOOSE_DECREASE, TIGHT_DECREASE = 1e-2, 1e-4
# Moves along a valley of equally good points towards nominal: their largest number, and the share of a parameter's
# range below which one ends them.
MOST_MOVES, NEAREST_WITHIN = 10, 0.01


def starting_points(
    search_result: EvolutionResult, low: Float[Tensor, " P"], high: Float[Tensor, " P"], count: int
) -> Float[Tensor, "K P"]:
    """Starting points of the refinement, K <= count: the best distant members of the search, best first."""
    members = distant_members(search_result.population, search_result.cost, high - low, count)[0]
    is_repeated = (members[1:] == members[0]).all(-1)
    return torch.cat([members[:1], members[1:][~is_repeated]])


def refine_to_convergence(
    fitting: Fitting,
    settings: HybridSettings,
    starts: Float[Tensor, "K P"],
    low: Float[Tensor, " P"],
    high: Float[Tensor, " P"],
    step: float,
    on_iteration: Callable[[Progress], None] | None,
) -> tuple[Refined, float]:
    """Refine from every start (K, P), take the best optimum, and halve the integration step (s) until it converges.

    The step has converged when halving it changes every standard error by at most the fraction `std_tolerance` and
    every value by at most 5 % of its standard error. Returns the optimum and the last step.
    """

    def run(theta: Tensor, at: float) -> Refined:
        linearise = fitting.problem(at, settings.objectives[1]).linearise
        stop = stopping_at(settings, TIGHT_DECREASE) if fitting.takes_own_steps(at) else settings.refine
        return levenberg_marquardt(linearise, theta[None], low, high, stop, on_iteration).best()

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
    starts: Float[Tensor, "K P"],
    low: Float[Tensor, " P"],
    high: Float[Tensor, " P"],
    coarse: float,
    on_iteration: Callable[[Progress], None] | None,
) -> Refined:
    """Refine from every start (K, P) with coarse fixed steps (s), then from the best one with an adaptive solver.

    The adaptive solver runs twice, first with a loose and then with a tight tolerance.
    """

    def run(problem: Problem, theta: Tensor, decrease: float) -> Refined:
        stop = stopping_at(settings, decrease)
        return levenberg_marquardt(problem.linearise, theta[None], low, high, stop, on_iteration).best()

    refinement = run(fitting.problem(coarse, settings.objectives[1]), starts, LOOSE_DECREASE)
    scale = time_scale(fitting.plant)
    for step in ADAPTIVE_STEPS:
        problem = fitting.problem(step * scale, settings.objectives[1], adaptive=True)
        refinement = run(problem, refinement.theta, TIGHT_DECREASE if step == ADAPTIVE_STEPS[-1] else LOOSE_DECREASE)
    return refinement


def nearest_to_nominal(
    problem: Problem, refinement: Refined, low: Tensor, high: Tensor, stop: RefineSettings
) -> Refined:
    """The optimum nearest to the nominal values among those that fit equally well.

    Where only a combination of parameters is determined, the optima form a valley, often a curved one, on which search
    and refinement end anywhere. The sensitivities change along it: next to a bound, a fault may hide the error of a
    constant, and the combination then seems far better determined than it is. The undetermined part of the deviation
    from nominal is therefore removed, and the point refined again, until that moves it no further.
    """
    for _ in range(MOST_MOVES):
        uncertainty = certainty(refinement.curvature[0])
        deviation = (refinement.theta[0] - problem.space.nominal()) / uncertainty.scale
        change = uncertainty.scale * (uncertainty.null @ deviation)
        moved = (refinement.theta - change).clamp(low, high)
        if not bool(((moved - refinement.theta).abs() > NEAREST_WITHIN * (high - low)).any()):
            break
        again = levenberg_marquardt(problem.linearise, moved, low, high, stop)
        if not float(again.cost[0]) < float(refinement.cost[0]) + LOOSE_DECREASE:
            break
        refinement = again
    return refinement


def unrefined(
    fitting: Fitting, settings: HybridSettings, starts: Tensor, low: Tensor, high: Tensor, step: float
) -> Refined:
    """The first of the starts (K, P), unchanged, with the gradient and curvature of the cost there; `step` in s."""
    problem = fitting.problem(step, settings.objectives[1], settings.adaptive)
    return levenberg_marquardt(problem.linearise, starts[:1], low, high, replace(settings.refine, iterations=0))


def stopping_at(settings: HybridSettings, decrease: float) -> RefineSettings:
    """Settings that stop the refinement as soon as the Newton decrement is below `decrease`.

    For a negative log-likelihood the decrement is d^2 / 2 with d the distance to the optimum in standard errors.
    """
    return replace(settings.refine, decrease_tolerance=max(settings.refine.decrease_tolerance, decrease))


def status_of(refinement: Refined) -> str:
    """Status of a batch of one.

    A member that stalled, or that was not iterated at all, counts as 'converged' if its Newton decrement places it
    within `CONVERGED_WITHIN` standard errors of the optimum. Otherwise a member without iterations is 'not refined'.
    """
    status = refinement.statuses()[0]
    near_optimum = float(refinement.newton_decrement[0]) < 0.5 * CONVERGED_WITHIN**2
    no_iterations = status == "max_iterations" and not int(refinement.iterations[0])
    if (status == "stalled" or no_iterations) and near_optimum:
        return "converged"
    return "not refined" if no_iterations else status


def information_std(problem: Problem, theta: Float[Tensor, "one P"]) -> Float[Tensor, " P"]:
    """Standard errors (P,) from the Gauss-Newton curvature at theta (1, P); infinite for undetermined parameters."""
    return certainty(problem.linearise(theta, torch.zeros(1, dtype=torch.int64)).curvature[0]).std
