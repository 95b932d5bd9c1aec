"""A trajectory that did not converge is rejected, however close its readings are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from fdi_torch.gap import trajectory_problem
from fdi_torch.gap.candidate_fit import Candidate, Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from tests.rigs import constant_inputs, three_tank


@pytest.mark.parametrize(("defect", "taken"), [(1.0, False), (1e-9, True)])
def test_a_step_is_accepted_only_if_its_trajectory_satisfies_the_model(
    defect: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = three_tank()
    blank = constant_inputs(plant, 100.0)
    far_off = torch.full((len(blank.time), len(plant.sensors)), 0.5, dtype=torch.float64)
    data = data_set_of(plant, [], replace(blank, outputs=far_off, mask=None), 1.0)  # type: ignore[arg-type]
    zero = torch.zeros(len(plant.sensors), dtype=torch.float64)
    fitter = Fitter(data, Noise(zero + 1e-3, zero))
    before = fitter.fit(Candidate(), cap=0)

    def perfect(engine: Any, theta: Any, guess: Any, shift: Any, far: float) -> Any:
        linearised = engine.linearise(theta, guess)
        return replace(
            linearised,
            readings=data.readings.expand_as(linearised.readings),
            defect=torch.full_like(linearised.defect, defect),
        )

    monkeypatch.setattr(trajectory_problem, "follow_trajectories", perfect)
    after = fitter.fit(Candidate(), before, cap=1)
    assert (after.cost < 0.5 * before.cost) is taken
