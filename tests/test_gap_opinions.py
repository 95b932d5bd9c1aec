"""Second opinions of the gap diagnosis: predictions of unseen stretches, spectral lines, the temper of the evidence."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fdi_torch.gap.evidence import temperature
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
