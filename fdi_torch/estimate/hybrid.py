"""Hybrid parameter estimation: differential evolution finds the basin, Levenberg-Marquardt refines the optimum.

The search simulates with a coarse integration step, the refinement with a fine one. Unless a step is prescribed, the
refinement halves it until estimates and standard errors no longer depend on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.device import on_its_device
from fdi_torch.estimate.diagnosis import Diagnosis, diagnose
from fdi_torch.estimate.evolution import EvolutionResult, Search, evolve
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.lack_of_fit import explained_share, residuals_of
from fdi_torch.estimate.levenberg_marquardt import Progress
from fdi_torch.estimate.linearisation import Refined
from fdi_torch.estimate.misfit import channel_misfit, worst
from fdi_torch.estimate.objectives import Problem
from fdi_torch.estimate.refinement import (
    ADAPTIVE_STEPS,
    HybridSettings,
    nearest_to_nominal,
    refine_adaptively,
    refine_to_convergence,
    starting_points,
    status_of,
    unrefined,
    with_less_effort,
)
from fdi_torch.estimate.uncertainty import Estimate, make_estimate
from fdi_torch.plant.scales import time_scale
from fdi_torch.simulate.engine import Engine
from fdi_torch.simulate.step_length import choose_step, probe_points, step_ladder
from fdi_torch.tables import Shown, Table, in_its_units

# The longest step of the first probing simulation, in units of the plant's time scale.
FIRST_STEP = 5.0
# Tanks are stable, so integration errors do not accumulate: the first samples of a long recording show their size.
PROBE_SAMPLES = 20_000


@dataclass(frozen=True, repr=False)
class HybridResult(Shown):
    """The estimate, its diagnosis, and how it was computed.

    likelihood: negative log-likelihood behind the standard errors, with the noise levels of the estimate.
    correlation (C,): between readings and predictions of the first recording, per channel.
    predicted: readings (S, C) of each recording, simulated at the estimate, SI units. noise: noise level (C,) of each
    recording, in the readings' units.
    steps: integration steps of search and refinement, s. engine: name of the simulation engine.
    """

    estimate: Estimate
    diagnosis: Diagnosis
    search: EvolutionResult
    likelihood: Problem
    correlation: Tensor
    predicted: tuple[Tensor, ...]
    noise: tuple[Tensor, ...]
    steps: tuple[float, float]
    engine: str

    @property
    @in_its_units
    def headline(self) -> str:
        """The diagnosis in one sentence; it begins with a warning if the model does not explain the recording."""
        warning = self.estimate.warning
        return f"{warning}. {self.diagnosis.headline}" if warning else self.diagnosis.headline

    def table(self) -> Table:
        """As of the estimate."""
        return self.estimate.table()


@on_its_device
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
    settings = with_less_effort(settings) if fitting.is_slow else settings
    low, high = search_box(fitting)
    coarse, fine = pick_steps(fitting, settings, low, high)
    cost, box = fitting.problem(coarse, settings.objectives[0]).cost, (low[None], high[None])
    result = evolve(cost, *box, settings.search, seed, on_generation=on_generation, resume=resume)
    starts = starting_points(result, low, high, settings.starts)
    low, high = fitting.space.low(), fitting.space.high()  # only the search needs a box about the priors
    if settings.method == "none":
        refinement = unrefined(fitting, settings, starts, low, high, fine)
    elif settings.adaptive:
        refinement = refine_adaptively(fitting, settings, starts, low, high, coarse, on_iteration)
    else:
        refinement, fine = refine_to_convergence(fitting, settings, starts, low, high, fine, on_iteration)
    if settings.method != "none":
        problem = fitting.problem(fine, settings.objectives[1], settings.adaptive)
        refinement = nearest_to_nominal(problem, refinement, low, high, settings.refine)
    return conclude(fitting, settings, result, refinement, (coarse, fine))


def search_box(fitting: Fitting) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """Bounds low, high of the search: each parameter's range, cut to four prior standard deviations about nominal.

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


def pick_steps(
    fitting: Fitting, settings: HybridSettings, low: Float[Tensor, " P"], high: Float[Tensor, " P"]
) -> tuple[float, float]:
    """Integration steps (s) of search and refinement.

    Prescribed steps are taken as given. Otherwise this is the longest step whose integration error, probed at points of
    the box from low to high, is within the tolerance.
    """
    points = probe_points(low, high)
    spans = [float(r.time[-1] - r.time[0]) for r in fitting.recordings]
    longest, scale = max(min(spans) / 20.0, 1e-6), time_scale(fitting.plant)
    shortest = min(range(len(spans)), key=spans.__getitem__)
    interval = fitting.recordings[shortest].interval
    beginning = fitting.beginning(shortest, PROBE_SAMPLES)

    def engine_at(step: float) -> Engine:
        return beginning.engines(step)[0]

    recording_points = points[:, fitting.columns[shortest]]
    coarse = settings.search_step
    readings = engine_at(min(longest, FIRST_STEP * scale)).readings(recording_points)
    std = readings.flatten(0, 1).std(dim=0).clamp(min=1e-12)
    if coarse is None:
        ladder = step_ladder(interval, scale, longest)
        coarse = choose_step(engine_at, recording_points, settings.search_tolerance * std, ladder, 0.9)
    fine = ADAPTIVE_STEPS[-1] * scale if settings.adaptive else settings.refine_step
    if fine is None:
        ladder = step_ladder(interval, scale, coarse)
        fine = choose_step(engine_at, recording_points, settings.refine_tolerance * std, ladder, 0.9)
    return coarse, fine


def conclude(
    fitting: Fitting,
    settings: HybridSettings,
    search_result: EvolutionResult,
    refinement: Refined,
    steps: tuple[float, float],
) -> HybridResult:
    """Compute estimate, diagnosis and goodness of fit at the refined optimum.

    Standard errors use each channel's noise level times the square root of `whiteness.correlation_inflation` of the
    residuals of each step, because correlated residuals carry less information than independent ones.
    """
    theta = refinement.theta
    lanes = torch.zeros(1, dtype=torch.int64)
    problem = fitting.problem(steps[1], "likelihood", settings.adaptive)
    raw = fitting.problem(steps[1], "likelihood", settings.adaptive, averaged=False)
    predicted, misfits, inflated_noise, residuals = [], [], [], []
    noise = [level[0] for level in raw.noise(theta, lanes)]
    for term, noise_level in zip(raw.terms, noise, strict=True):
        predicted.append(term.engine.readings(term.theta(theta))[0])
        misfits.append(channel_misfit(noise_level, term.data.known, term.data.weight))
    for term, noise_level in zip(problem.terms, problem.noise(theta, lanes), strict=True):
        residuals.append(residuals_of(term, theta, len(problem.terms) * len(fitting.plant.sensors)))
        inflated_noise.append(noise_level[0] * torch.sqrt(residuals[-1].inflation))
    likelihood = problem.at_noise(inflated_noise)
    curvature = likelihood.linearise(theta, lanes).curvature[0]
    samples = torch.stack([term.data.degrees for term in raw.terms])
    pooled = (samples * torch.stack(noise) ** 2).sum(dim=0) / samples.sum(dim=0).clamp(min=1.0)
    estimate = make_estimate(
        fitting.space,
        theta[0],
        curvature,
        status=status_of(refinement),
        noise_std=torch.sqrt(pooled),
        reached={"search": search_result.reasons()[0], "refinement": refinement.statuses()[0], "steps_s": list(steps)},
    )
    first = raw.terms[0]
    levels = first.engine.levels(first.theta(theta))[0].mean(dim=0)
    channels = fitting.recordings[0].input_columns(fitting.plant.channels())
    means = fitting.recordings[0].inputs[:, channels].mean(dim=0)
    flags = torch.stack([part.correlated for part in residuals]).any(0).tolist()
    correlated = tuple(s.name for s, flag in zip(fitting.plant.sensors, flags, strict=True) if flag)
    diagnosis = diagnose(
        fitting.networks[0],
        fitting.space,
        theta[0],
        estimate.std,
        levels,
        means,
        replace(worst(misfits), correlated=correlated),
        settings.confidence,
        estimate.combinations,
        likelihood.linearise,
    )
    if correlated and diagnosis.claims and diagnosis.misfit.explained:
        faults = [fitting.space.names.index(fault.name) for fault in diagnosis.faults]
        share = explained_share(likelihood, fitting.space, theta[0], faults, residuals)
        diagnosis = replace(diagnosis, misfit=replace(diagnosis.misfit, share=share))
    return HybridResult(
        estimate=estimate,
        diagnosis=diagnosis,
        search=search_result,
        likelihood=likelihood,
        correlation=raw.correlations(theta.unsqueeze(1), lanes)[0, 0],
        predicted=tuple(predicted),
        noise=tuple(noise),
        steps=steps,
        engine=problem.terms[0].engine.why or problem.terms[0].engine.name,
    )
