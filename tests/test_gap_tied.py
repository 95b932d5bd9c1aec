"""Causes tied to the clock of one recording have to close more than is left open beside them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch

from fdi_torch.effects import EFFECTS, effect
from fdi_torch.gap import tied as module
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.fitting import Candidate, Fit
from fdi_torch.gap.tied import paying, pays, tied
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.effect import Placement, fits
from tests.rigs import three_tank
from tests.test_gap_search import LIBRARY, MISSING, PLANT, STANDING, recorded, wandering

NOTHING: Any = None


def fit(cost: float, values: Mapping[str, float]) -> Fit:
    """A fit of the effects whose parameters have these names."""
    prefixes = dict.fromkeys(name.rpartition(".")[0] for name in values)
    placements = [Placement(effect(p.partition(".")[2]), p.partition(".")[0]) for p in prefixes]
    space = ParameterSpace([Parameter(name, "1", 0.0) for name in values])
    theta = torch.tensor(list(values.values()), dtype=torch.float64)
    return Fit(Candidate(tuple(placements)), space, theta, cost, NOTHING)


def test_an_effect_is_tied_where_its_moment_was_fitted() -> None:
    size = {"bottom.plugging.size": 0.2}
    assert tied(fit(0.0, size)) == []
    assert tied(fit(0.0, size | {"bottom.plugging.onset": 90.0})) == [("plugging", "bottom")]
    assert tied(fit(0.0, {"bottom.coefficient_drift.rate": 1e-5})) == [("coefficient_drift", "bottom")]
    assert tied(fit(0.0, {"pump.pump_lag.time_constant": 9.0})) == []


def test_what_ties_an_effect_to_the_clock_is_a_parameter_of_it() -> None:
    plant = three_tank()
    for each in EFFECTS:
        if each.on_clock != ("onset",):
            place = next(p for p in plant.locations() if fits(each, plant, p))
            assert set(each.on_clock) <= {p.name for p in each.parameters(place, plant)}, each.name


def test_what_is_tied_closes_more_than_it_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    standing = {"upper.overflow.below_rim": 0.2}
    onset = {"bottom.plugging.size": 0.2, "bottom.plugging.onset": 90.0}
    without, beside = fit(2000.0, standing), fit(1400.0, standing | onset)
    known = {f.key: f for f in (without, beside)}
    for left, paid in ((590.0, True), (610.0, False)):
        monkeypatch.setattr(module, "left_open", lambda fitter, fit, left=left: left)
        assert pays(NOTHING, beside, known) is paid
        assert pays(NOTHING, beside, {beside.key: beside})  # nothing to tell it by
        assert paying(NOTHING, known.values(), known) == ([without, beside] if paid else [without])
    weak = fit(1950.0, standing | onset)
    monkeypatch.setattr(module, "left_open", lambda fitter, fit: 140.0)  # no more than noise leaves
    assert pays(NOTHING, weak, known | {weak.key: weak})


@pytest.mark.parametrize("plugged", [False, True])
def test_a_change_in_time_is_named_where_there_was_one(plugged: bool) -> None:
    """Beside an overflow, with laws that the library lacks: a drift would take up what they miss."""
    truth = {k: v for k, v in (STANDING | MISSING).items() if "curvature" not in k}
    truth |= {"bottom.plugging.size": 0.3, "bottom.plugging.onset": 1400.0} if plugged else {}
    recording = recorded(truth, wandering(1024, 4)[256:896])
    library = (*LIBRARY, "pump_oscillation", "coefficient_drift", "unmetered_flow")
    found = diagnose(PLANT, recording, settings=Settings(library=library, most=3, named_only=True))
    timed = {name for c in found.causes for name in c.parameters} & {"onset", "rate", "phase", "begin"}
    assert bool(timed) is plugged
