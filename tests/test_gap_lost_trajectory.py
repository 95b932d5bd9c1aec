"""A trajectory that did not converge is rejected, however close its readings are."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.trajectory_problem import TrajectoryProblem
from tests.rigs import constant_inputs, three_tank


@pytest.mark.parametrize(("zigzag", "taken"), [(0.1, False), (0.0, True)])
def test_a_trial_counts_only_if_its_trajectory_satisfies_the_model(zigzag: float, taken: bool) -> None:
    plant = three_tank()
    blank = constant_inputs(plant, 100.0)
    far_off = torch.full((len(blank.time), len(plant.sensors)), 0.5, dtype=torch.float64)
    data = data_set_of(plant, [], replace(blank, outputs=far_off, mask=None), 1.0)
    zero = torch.zeros(len(plant.sensors), dtype=torch.float64)
    fitter = Fitter(data, Noise(zero + 1e-3, zero))
    fit = fitter.fit(Candidate(), cap=0)
    problem = TrajectoryProblem(fitter, fitter.engine(Candidate(), []), fit.linearised.levels)
    theta = fit.theta.unsqueeze(0)
    known = problem.linearise(theta, torch.tensor([0]))
    trial = problem.attempt(theta, known, torch.zeros_like(theta))
    assert torch.isfinite(trial.cost).all()
    sign = (-1.0) ** torch.arange(trial.levels.shape[1], dtype=torch.float64)
    moved = replace(trial, levels=trial.levels + zigzag * sign[:, None])
    assert bool(torch.isfinite(problem.model(theta, moved).cost).all()) is taken
