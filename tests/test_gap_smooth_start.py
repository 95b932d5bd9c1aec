"""A course of the levels that is found only by way of smoother plants."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from fdi_torch.gap import smooth_start as module
from fdi_torch.gap.case import Settings, case_of
from fdi_torch.gap.fitting import Candidate, Fit
from fdi_torch.gap.smooth_start import WIDENINGS, first_fit, followed
from tests.test_gap_search import PLANT, STANDING, recorded, wandering


class Stiff:
    """Finds a course only from one found at most four times as smooth; `asked`: at what resolution, and from there."""

    asked: list[tuple[float, bool]]
    sharp: float

    def __init__(self, subject: Any, noise: Any) -> None:
        self.subject, self.noise = subject, noise

    def fit(self, candidate: Candidate, base: Any = None) -> Any:
        resolution = float(self.subject.experiment.resolution)
        Stiff.asked.append((resolution / Stiff.sharp, base is not None))
        near = base.resolution <= 4.0 * resolution if base else resolution > 20.0 * Stiff.sharp
        return SimpleNamespace(cost=1.0 if near else float("nan"), near=NEAR, resolution=resolution)


NEAR = SimpleNamespace(jacobian=torch.zeros(1))


def test_a_course_is_followed_from_the_smoothest_plant_to_the_sharp_one(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = recorded(STANDING, wandering(1024, 4)[256:400])
    subject = case_of(PLANT, (recording,), (), Settings()).subject
    Stiff.asked, Stiff.sharp = [], float(subject.experiment.resolution)
    monkeypatch.setattr(module, "Fitter", Stiff)
    found: Fit = first_fit(Stiff(subject, None), Candidate())  # type: ignore[arg-type]
    assert followed(found)
    assert Stiff.asked == [(1.0, False), (WIDENINGS[0], False), *((w, True) for w in WIDENINGS[1:]), (1.0, True)]
    Stiff.asked = []
    easy = replace(subject, experiment=replace(subject.experiment, resolution=30.0 * subject.experiment.resolution))
    assert followed(first_fit(Stiff(easy, None), Candidate()))  # type: ignore[arg-type]
    assert len(Stiff.asked) == 1
