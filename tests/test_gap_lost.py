"""A trajectory that was not followed to its end is no answer, however close its readings are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from fdi_torch.gap import fitting
from fdi_torch.gap.fitting import Candidate, Fitter
from fdi_torch.gap.floor import Noise
from fdi_torch.gap.subject import subject_of
from tests.rigs import constant_inputs, three_tank


@pytest.mark.parametrize(("defect", "taken"), [(1.0, False), (1e-9, True)])
def test_a_step_is_taken_only_where_its_trajectory_is_the_models(
    defect: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = three_tank()
    blank = constant_inputs(plant, 100.0)
    far_off = torch.full((len(blank.time), len(plant.sensors)), 0.5, dtype=torch.float64)
    subject = subject_of(plant, [], replace(blank, outputs=far_off, mask=None), 1.0)  # type: ignore[arg-type]
    zero = torch.zeros(len(plant.sensors), dtype=torch.float64)
    fitter = Fitter(subject, Noise(zero + 1e-3, zero))
    before = fitter.fit(Candidate(), cap=0)

    def perfect(engine: Any, theta: Any, guess: Any, shift: Any, far: float) -> Any:
        near = engine.linearise(theta, guess)
        return replace(
            near, readings=subject.readings.expand_as(near.readings), defect=torch.full_like(near.defect, defect)
        )

    monkeypatch.setattr(fitting, "_followed", perfect)
    after = fitter.fit(Candidate(), before, cap=1)
    assert (after.cost < 0.5 * before.cost) is taken
