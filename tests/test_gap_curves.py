"""The free curve at every kind of component agrees with the effect there, without knowing it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest
import torch

from fdi_torch.effects import effect
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.discrepancy_curves import curves_at
from fdi_torch.gap.free_form import fitted_free_form
from fdi_torch.gap.localization.localized_discrepancy import LocalizedDiscrepancy
from fdi_torch.gap.problem import checked_data_set
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of
from tests.test_gap import nominal_plant, recorded


@pytest.mark.parametrize(
    ("name", "place", "values", "quantity", "variable"),
    [
        ("pump_gain", "Q1", {"factor": 1.15}, "flow", "Q1 commanded"),
        ("leak", "T3", {"size": 0.15}, "flow", "level of T3"),
        ("cross_flow", "T1-T2", {"size": 0.2}, "flow", "T1 − T2"),
        ("outlet_drop", "OUT2", {"drop": 0.05}, "flow", "level of T2"),
        ("area_taper", "T1", {"taper": 0.4}, "area", "level of T1"),
        ("sensor_gain", "h1", {"factor": 1.05}, "reading", "h1 read"),
    ],
)
def test_the_free_curve_agrees_with_the_effect_that_is_there(
    name: str, place: str, values: dict[str, float], quantity: str, variable: str
) -> None:
    truth = {f"{place}.{name}.{key}": value for key, value in values.items()}
    recording = recorded(truth, 13, samples=600)
    white = Noise(torch.full((3,), 1e-3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    fitter = Fitter(checked_data_set(nominal_plant(), (), [recording], None), white)
    fit = fitter.fit(Candidate((Placement(effect(name), place),), (truth,)))
    first, *_, last = curves_at(fitter, fit, place, operating_range_of(recording, nominal_plant()))
    assert (first.quantity, first.variable, last.variable) == (quantity, variable, "time")
    for curve in (first, last):
        assert curve.effect is not None
        apart = (curve.free - curve.effect).abs()
        assert bool((apart < 5.0 * curve.free_std + 0.1 * curve.effect.abs().max()).all()), curve.variable
        assert float(curve.effect.abs().max()) > 3.0 * float(curve.free_std.median())


@pytest.mark.parametrize("quantities", [{"flow"}, {"flow", "area"}])
def test_the_free_form_of_a_tank_shows_a_draw_as_a_flow(quantities: set[str]) -> None:
    """A draw in mid-record. If the cross-section is free as well, it has a curve of its own."""
    truth = {"T1.unmetered_flow.flow": -8e-6, "T1.unmetered_flow.begin": 200.0, "T1.unmetered_flow.duration": 200.0}
    recording = recorded(truth, 13, samples=600)
    white = Noise(torch.full((3,), 1e-3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    fitter = Fitter(checked_data_set(nominal_plant(), (), [recording], None), white)
    reach = operating_range_of(recording, nominal_plant())
    unknown = SimpleNamespace(location="T1", periods=(), quantities=quantities)
    fit = fitted_free_form(fitter, fitter.fit(Candidate()), (), cast(LocalizedDiscrepancy, unknown), reach)
    curves = {(c.quantity, c.variable): c for c in curves_at(fitter, fit, "T1", reach)}
    assert {quantity for quantity, _ in curves} == quantities
    flow = curves["flow", "time"]
    draw = torch.where((flow.at > 200.0) & (flow.at < 400.0), -8e-6, 0.0)
    assert float((flow.free - draw).square().mean().sqrt()) < 2e-6  # piecewise linear between nodes 40 s apart
