"""The choice among explanations by stretches left out, and what components alike may have in common."""

from dataclasses import replace

import pytest
import torch

from fdi_torch.config.plant import load_plant
from fdi_torch.gap.alike import alike, missing, repeated
from fdi_torch.gap.case import Settings, case_of
from fdi_torch.gap.diagnose import diagnose
from fdi_torch.gap.fitting import Candidate, Fitter
from fdi_torch.gap.floor import Noise
from fdi_torch.gap.stretches import STRETCHES, errors_unseen
from tests.test_gap_search import MISSING, PLANT, STANDING, recorded, wandering

RIMS = {("overflow", "upper"), ("overflow", "lower")}


def test_components_with_the_same_numbers_are_alike() -> None:
    assert alike(PLANT, "upper") == ("lower",)
    assert alike(PLANT, "pump") == ()
    assert set(alike(load_plant("three_tank"), "T2")) == {"T1", "T3"}
    assert alike(load_plant("three_tank"), "T1-T2") == ()


def test_only_what_comes_with_the_build_is_expected_at_its_like() -> None:
    assert missing({("overflow", "upper"), ("leak", "lower")}, PLANT) == [("overflow", "lower")]
    assert missing(RIMS, PLANT) == missing({("leak", "upper")}, PLANT) == []
    assert repeated(RIMS | {("leak", "upper")}, PLANT) == 1
    assert repeated({("overflow", "upper"), ("leak", "lower")}, PLANT) == 0
    three = load_plant("three_tank")
    assert missing({("overflow", "T1")}, three) == [("overflow", "T2"), ("overflow", "T3")]
    assert repeated({("overflow", "T1"), ("overflow", "T3")}, three) == 1


def test_an_error_of_a_stretch_is_that_of_a_fit_that_has_not_seen_it() -> None:
    """Readings there that are higher and lower by d: (m+ + m-) / 2 = m + d^2, if the fit is the same in all three."""
    recording = recorded(STANDING, wandering(1024, 4)[256:556])
    subject = case_of(PLANT, (recording,), (), Settings()).subject
    noise = Noise(torch.tensor([0.015], dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    null = Fitter(subject, noise).fit(Candidate(), rounds=20)
    off = torch.zeros_like(subject.readings)
    off[250:] = 0.3  # the last of six stretches
    none, up, down = (
        errors_unseen(Fitter(replace(subject, readings=subject.readings + turn * off), noise), null)
        for turn in (0.0, 1.0, -1.0)
    )
    assert len(none) == STRETCHES
    assert 0.5 * (up[-1] + down[-1]) == pytest.approx(none[-1] + (0.3 / 0.015) ** 2, rel=1e-9)
    assert up[-2] != none[-2]  # fits that see the last stretch follow it


def test_a_rim_is_taken_where_the_tank_alike_has_one() -> None:
    truth = {k: v for k, v in (STANDING | MISSING).items() if "curvature" not in k}
    truth |= {"lower.overflow.below_rim": 0.2, "lower.overflow.crest": 0.02}
    recording = recorded(truth, wandering(1024, 4)[256:896])
    settings = Settings(library=("overflow", "leak"), most=2, named_only=True, cross_validate=True)
    found = diagnose(PLANT, recording, settings=settings)
    assert {(c.effect, c.location) for c in found.causes} >= RIMS
