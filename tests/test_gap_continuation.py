"""Continuation: a trajectory that is found only through smoothed plants."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.free_runs import refit as module
from fdi_torch.gap.free_runs.refit import WIDENINGS, fit_by_continuation, trajectory_found
from fdi_torch.gap.problem import Settings, problem_of
from tests.test_gap_search import PLANT, STANDING, recorded, wandering


class Stiff:
    """Finds a course only from one found at most four times as smooth; `asked`: at what resolution, and from there."""

    asked: list[tuple[float, bool]]
    sharp: float

    def __init__(self, data: Any, noise: Any) -> None:
        self.data, self.noise = data, noise

    def fit(self, candidate: Candidate, base: Any = None) -> Any:
        resolution = float(self.data.experiment.resolution)
        Stiff.asked.append((resolution / Stiff.sharp, base is not None))
        linearised = base.resolution <= 4.0 * resolution if base else resolution > 20.0 * Stiff.sharp
        return SimpleNamespace(cost=1.0 if linearised else float("nan"), linearised=NEAR, resolution=resolution)


NEAR = SimpleNamespace(jacobian=torch.zeros(1))


def test_continuation_runs_from_the_smoothest_plant_to_the_sharp_one(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = recorded(STANDING, wandering(1024, 4)[256:400])
    data = problem_of(PLANT, (recording,), (), Settings()).data
    Stiff.asked, Stiff.sharp = [], float(data.experiment.resolution)
    monkeypatch.setattr(module, "Fitter", Stiff)
    found: Fit = fit_by_continuation(Stiff(data, None), Candidate())  # type: ignore[arg-type]
    assert trajectory_found(found)
    assert Stiff.asked == [(1.0, False), (WIDENINGS[0], False), *((w, True) for w in WIDENINGS[1:]), (1.0, True)]
    Stiff.asked = []
    easy = replace(data, experiments=(replace(data.experiment, resolution=30.0 * data.experiment.resolution),))
    assert trajectory_found(fit_by_continuation(Stiff(easy, None), Candidate()))  # type: ignore[arg-type]
    assert len(Stiff.asked) == 1
