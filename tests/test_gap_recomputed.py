"""Results that are computed anew unless they were used recently."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from fdi_torch.gap import recomputed
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.recomputed import Recomputed
from tests.rigs import constant_inputs, three_tank


def test_the_results_used_last_are_kept_as_far_as_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recomputed, "KEPT", 170)
    computed: list[int] = []

    def compute(k: int) -> torch.Tensor:
        computed.append(k)
        return torch.full((10,), float(k), dtype=torch.float64)  # 80 bytes

    first, second, third = (Recomputed(lambda k=k: compute(k)) for k in range(3))
    assert [float(each()[0]) for each in (first, second, first, third, first, second)] == [0.0, 1.0, 0.0, 2.0, 0.0, 1.0]
    assert computed == [0, 1, 2, 1]
    del first, second, third
    assert not any(each() for each in Recomputed._recent)


def test_derivatives_that_are_computed_anew_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = three_tank()
    blank = constant_inputs(plant, 100.0)
    readings = torch.full((len(blank.time), len(plant.sensors)), 0.2, dtype=torch.float64)
    zero = torch.zeros(len(plant.sensors), dtype=torch.float64)
    fitter = Fitter(data_set_of(plant, [], replace(blank, outputs=readings, mask=None), 1.0), Noise(zero + 1e-3, zero))
    fit = fitter.fit(Candidate())
    before = fit.linearised
    monkeypatch.setattr(recomputed, "KEPT", 0)
    Recomputed(lambda: torch.zeros(1))()
    after = fit.linearised
    assert after is not before
    for field in fields(before):
        assert torch.equal(getattr(after, field.name), getattr(before, field.name)), field.name
