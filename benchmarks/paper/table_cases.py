"""One row of Table 2 or 3: a run file simulated and estimated, with the search alone and the Cramer-Rao bound."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.paper.published import PARAMETERS
from fdi_torch.config.run_file import Run, load_run
from fdi_torch.config.simulation import NoiseConfig, noise_std
from fdi_torch.config.yaml_files import SHIPPED
from fdi_torch.estimate.evolution import Search
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.hybrid import estimate_parameters
from fdi_torch.estimate.levenberg_marquardt import levenberg_marquardt
from fdi_torch.estimate.refinement import information_std
from fdi_torch.jobs.run_setup import fitting_of, hybrid_settings, recordings_of, requested_space, simulated_truth

BOUND_SNR = 50.0
"""SNR in dB for which the bound of a noise-free row is stated."""


@dataclass(frozen=True)
class Case:
    """Results, all (P,) in the order of `PARAMETERS`.

    searched: where differential evolution on the sum of correlations alone ends. refined, std: the hybrid estimate
    within the paper's box. free: the same without a box. bound: the Cramer-Rao bound at the truth. history
    (generations, P): the best member after each generation. correlation: sum over the sensors at the estimate.
    """

    name: str
    snr_db: float | None
    truth: Tensor
    searched: Tensor
    refined: Tensor
    std: Tensor
    free: Tensor
    bound: Tensor
    correlation: float
    searched_correlation: float
    history: Tensor
    status: str
    steps: tuple[float, float]


def shipped_run(name: str) -> Run:
    """The run file of configs/paper with this name."""
    return load_run(SHIPPED / "paper" / f"{name}.yaml")


def solve(run: Run) -> Case:
    """Simulate, search, refine and bound the run file."""
    space = requested_space(run)
    if space.names != PARAMETERS:
        raise ValueError(
            f"{run.source}: expected the parameters {', '.join(PARAMETERS)}, got {', '.join(space.names)}; name these"
        )
    fitting = fitting_of(run, space, recordings_of(run))
    assert run.config.simulate is not None
    settings = hybrid_settings(run.config.estimate)
    truth = space.vector(simulated_truth(run))
    history: list[Tensor] = []

    def remember(search: Search) -> None:
        history.append(search.state.population[0, 0].clone())

    result = estimate_parameters(fitting, settings, run.config.seed, remember)
    step = result.steps[1]
    snr = run.config.simulate.noise.snr_db
    return Case(
        name=run.name,
        snr_db=snr,
        truth=truth,
        searched=result.search.best[0],
        refined=result.estimate.value,
        std=result.estimate.std,
        free=without_box(fitting, result.estimate.value, step),
        bound=bound_at(fitting, truth, step, BOUND_SNR if snr is None else snr),
        correlation=float(result.correlation.sum()),
        searched_correlation=len(result.correlation) - float(result.search.best_cost[0]),
        history=torch.stack(history),
        status=result.estimate.status,
        steps=result.steps,
    )


def without_box(fitting: Fitting, start: Tensor, step: float) -> Tensor:
    """The most likely parameters (P,) without bounds."""
    nowhere = torch.full_like(start, math.inf)
    linearise = fitting.problem(step, "likelihood").linearise
    return levenberg_marquardt(linearise, start.unsqueeze(0), -nowhere, nowhere).theta[0]


def bound_at(fitting: Fitting, truth: Tensor, step: float, snr_db: float) -> Tensor:
    """Cramer-Rao bound (P,) at the truth for white noise of this SNR (against the variance) at a known level."""
    clean = fitting.engines(step)[0].readings(truth.unsqueeze(0))[0]
    noise = noise_std(NoiseConfig(snr_db=snr_db), fitting.plant, clean)
    return information_std(fitting.problem(step).at_noise([noise]), truth.unsqueeze(0))
