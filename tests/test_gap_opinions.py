"""Second opinions of the gap diagnosis: predictions of unseen stretches, spectral lines, the temper of the evidence."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from fdi_torch.gap import evidence
from fdi_torch.gap.evidence import log_prior, opinions, plainest, temperature
from fdi_torch.gap.fitting import Candidate, Fitter
from fdi_torch.gap.floor import Noise
from fdi_torch.gap.folds import FOLDS, STRETCHES, held_out_cost
from fdi_torch.gap.subject import subject_of
from fdi_torch.gap.where.line import spectral_line
from tests.test_gap import believed, noise, recorded


def test_predictions_of_unseen_stretches_are_those_of_fits_without_them() -> None:
    recording = recorded({"P13.discharge_coefficient": 0.62}, 5, samples=400)
    white = Noise(torch.full((3,), 1e-3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    subject = subject_of(believed(), (), recording, 1.0)
    fit = Fitter(subject, white).fit(Candidate())
    turn = torch.arange(400) * FOLDS * STRETCHES // 400 % FOLDS
    total = 0.0
    for fold in range(FOLDS):
        seen = replace(subject, mask=subject.mask & (turn != fold).unsqueeze(1))
        without = Fitter(seen, white).fit(Candidate(), fit)
        left = (subject.readings - without.near.readings[0])[turn == fold] / 1e-3
        total += float((left * left).sum())
    assert held_out_cost(Fitter(subject, white), fit) == pytest.approx(total, rel=1e-4)
    assert total > fit.cost


def test_a_line_in_the_spectrum_is_found_and_a_slow_misfit_is_none() -> None:
    times = torch.arange(3000, dtype=torch.float64)
    slow = 0.01 * torch.sin(times / 200.0).unsqueeze(1) + noise(3000, 0.0, 0.002, 3)
    assert spectral_line(slow, 1.0) is None
    line = slow + 0.002 * torch.sin(2 * torch.pi * times / 47.3).unsqueeze(1)
    assert spectral_line(line, 1.0) == pytest.approx(47.3, rel=2e-3)


def test_evidence_is_tempered_by_what_the_best_explanation_leaves() -> None:
    assert temperature(4e5) == pytest.approx(101.0)
    assert temperature(4e5, 100.0) == pytest.approx(6.0)
    assert temperature(200.0, 0.0) == pytest.approx(1.001)
    assert temperature(4e6, 0.0) == pytest.approx(21.0), "five millionths of a gap part nobody"


def test_the_plainest_good_explanation_is_taken_before_one_that_closes_little_more() -> None:
    fits: list[Any] = [SimpleNamespace(key=range(n), cost=cost) for n, cost in enumerate((5000.0, 110.0, 100.0))]
    assert len(plainest(fits, gap=1e4).key) == 1, "the second effect closes a thousandth of the gap"
    assert len(plainest(fits, gap=1e3).key) == 2, "a hundredth"


def test_all_sets_of_effects_of_one_size_share_one_prior() -> None:
    """So that which effects a library of many holds is no evidence for there being several."""
    choices = 7
    one, two = (
        log_prior(SimpleNamespace(key=[("any", place) for place in places]), choices)  # type: ignore[arg-type]
        for places in (["T1"], ["T1", "T2"])
    )
    assert math.exp(one) * choices == pytest.approx(0.1)
    assert math.exp(two) * choices**2 / 2 == pytest.approx(0.1**2), "a set has no order"


def test_nothing_is_beyond_doubt_that_predictions_of_unseen_stretches_are_against(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = (("T1", 0.0, 900.0), ("T2", -20.0, 100.0), ("T3", -30.0, 0.0))  # log evidence, cost; of the last none asks
    fits: list[Any] = [SimpleNamespace(key=[("any", place)], evidence=e, left=cost) for place, e, cost in told]
    monkeypatch.setattr(evidence, "log_evidence", lambda fitter, fit, heat, choices: fit.evidence)
    monkeypatch.setattr(evidence, "held_out_cost", lambda fitter, fit: fit.left)
    assert opinions(None, fits, 1.0, 7) == pytest.approx([0.9, 0.1, 0.0], abs=1e-8)  # type: ignore[arg-type]
