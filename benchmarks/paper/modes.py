"""Diagnosis of all fault modes of the paper's five faults, each from several noise draws, in one batch."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from statistics import NormalDist

import torch
from torch import Tensor

from fdi_torch.config.run_file import Run
from fdi_torch.config.simulation import noise_std, planned_recording
from fdi_torch.estimate.evolution import evolve
from fdi_torch.estimate.fitting import Fitting, set_up
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import levenberg_marquardt
from fdi_torch.estimate.objectives import Objective, Problem, Term
from fdi_torch.jobs.run_setup import hybrid_settings, requested_space, simulated_truth
from fdi_torch.simulate.engine import Readings

SEARCH_STEP, FINE_STEP, DATA_STEP = 1.0, 0.05, 0.0125
"""Integration steps in s; that of the data is finer, so that data and estimator have different
discretization errors.
"""


@dataclass(frozen=True)
class Modes:
    """Estimates of all fault modes.

    modes (M, P) bool: faults of each mode; truth (M, P). With leading dimensions (M, draws): searched, refined, std
    (..., P), and stated (..., P) bool, the faults stated as present.
    """

    modes: Tensor
    truth: Tensor
    searched: Tensor
    refined: Tensor
    std: Tensor
    stated: Tensor

    @property
    def right(self) -> Tensor:
        """(M, draws) bool: whether exactly the true faults were named."""
        return (self.stated == self.modes.unsqueeze(1)).all(-1)


def all_modes(faults: int) -> Tensor:
    """(2^P - 1, P) bool: every non-empty set of faults, small sets first."""
    sets = [s for size in range(1, faults + 1) for s in combinations(range(faults), size)]
    modes = torch.zeros(len(sets), faults, dtype=torch.bool)
    for row, members in enumerate(sets):
        modes[row, list(members)] = True
    return modes


def mode_name(mode: Tensor) -> str:
    """(P,) bool -> '1 3 5'; '–' for no fault."""
    return " ".join(str(i + 1) for i in mode.nonzero().flatten().tolist()) or "–"


def diagnose_modes(run: Run, draws: int) -> Modes:
    """Every mode of the faults that the run simulates, with their simulated sizes, `draws` times."""
    fitting = planned_fitting(run)
    space, truth_of_all = fitting.space, fitting.space.vector(simulated_truth(run))
    modes = all_modes(len(space))
    truth = torch.where(modes, truth_of_all, space.nominal())
    data = noisy(run, fitting, truth, draws)
    settings = hybrid_settings(run.config.estimate)
    shape = (len(modes) * draws, len(space))
    low, high = space.low(), space.high()
    coarse = shared_problem(fitting, data, SEARCH_STEP, "correlation")
    search = evolve(coarse.cost, low.expand(shape), high.expand(shape), settings.search, seeds=run.config.seed)
    fine = shared_problem(fitting, data, FINE_STEP, "likelihood")
    refined = levenberg_marquardt(fine.linearise, search.best, low, high, settings.refine)
    assert refined.curvature is not None
    std = certainty(refined.curvature).std
    stated = called_present(refined.theta, std, space.nominal(), settings.confidence)
    parts = (search.best, refined.theta, std, stated)
    return Modes(modes, truth, *(part.reshape(len(modes), draws, len(space)) for part in parts))


def planned_fitting(run: Run) -> Fitting:
    """The run's estimation problem on a recording with inputs but without readings."""
    assert run.config.simulate is not None
    planned = planned_recording(run.config.simulate, run.plant)
    return set_up(run.plant, [planned], requested_space(run), run.config.simulate.start_levels, run.config.engine)


def noisy(run: Run, fitting: Fitting, truth: Tensor, draws: int) -> Readings:
    """Readings (M * draws, S, C) of every mode, each with its own noise."""
    assert run.config.simulate is not None
    noise = run.config.simulate.noise
    clean = fitting.engines(DATA_STEP)[0].readings(truth)
    std = torch.stack([noise_std(noise, run.plant, mode) for mode in clean])
    generator = torch.Generator().manual_seed(run.config.seed)
    white = torch.randn(len(truth), draws, *clean.shape[1:], generator=generator, dtype=clean.dtype)
    values = (clean.unsqueeze(1) + std[:, None, None] * white).flatten(0, 1)
    return Readings(values, torch.ones_like(values))


def shared_problem(fitting: Fitting, data: Readings, step: float, objective: Objective) -> Problem:
    """One problem for each set of readings, all with the same inputs."""
    return Problem(fitting.space, [Term(fitting.engines(step)[0], data, fitting.columns[0])], objective)


def called_present(value: Tensor, std: Tensor, nominal: Tensor, confidence: float) -> Tensor:
    """(..., P) bool: significantly different from nominal; the confidence is divided among the
    parameters (Bonferroni).
    """
    reach = NormalDist().inv_cdf(1.0 - 0.5 * (1.0 - confidence) / value.shape[-1])
    return (value - nominal).abs() > reach * std


def confusion(result: Modes) -> Tensor:
    """(M, M + 1) counts of simulated modes (rows) and stated modes (columns, 'no fault' first)."""
    faults = result.modes.shape[-1]
    known = torch.cat([torch.zeros(1, faults, dtype=torch.bool), result.modes])
    same = (result.stated.unsqueeze(2) == known).all(-1)
    return same.sum(1)
