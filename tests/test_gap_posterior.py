"""Prior odds, and normalised probabilities."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from fdi_torch.estimate.evidence import ODDS, posterior
from fdi_torch.gap.diagnose import Settings, diagnose, verdict_of
from fdi_torch.gap.localization.regressors import lagged
from fdi_torch.gap.marginal_likelihood import log_prior
from fdi_torch.gap.posterior import CauseHypothesis
from tests.test_gap import nominal_plant, recorded


def test_all_sets_of_effects_of_one_size_share_one_prior() -> None:
    """How many effects a library holds is no evidence for there being several."""
    choices = 7
    one, two = (log_prior([("any", place) for place in places], choices) for places in (["T1"], ["T1", "T2"]))
    assert math.exp(one) * choices == pytest.approx(ODDS.effect)
    assert math.exp(two) * choices**2 / 2 == pytest.approx(ODDS.effect**2), "a set has no order"


def test_two_effects_at_one_place_are_less_likely_than_at_two() -> None:
    apart, together = (log_prior([("leak", "T1"), ("area_taper", place)], 7) for place in ("T2", "T1"))
    assert apart - together == pytest.approx(-math.log(ODDS.same_place))


def test_probabilities_follow_from_differences_of_logarithms_alone() -> None:
    for shift in (0.0, 1e6, -1e6):
        assert posterior([shift + math.log(3.0), shift]) == pytest.approx([0.75, 0.25], rel=1e-6)


def test_no_gap_needs_95_percent_as_any_other_verdict() -> None:
    evaluated: Any = None
    nothing, leak = CauseHypothesis(evaluated, (), 0.0), CauseHypothesis(evaluated, (("leak", "T1"),), -2.0)
    assert verdict_of([nothing], True, []) == "no_gap"
    assert verdict_of([nothing, leak], False, []) == "ambiguous"
    assert verdict_of([nothing, leak], False, [("unknown", "h1")]) == "unknown"
    assert verdict_of([leak], True, []) == "named"


def test_an_unknown_that_an_effect_at_its_place_predicts_as_well_is_that_effect() -> None:
    """A ramp in time of a pipe's flow is one regressor of an unknown, and two parameters of a drifting coefficient."""
    drift = {"P32.coefficient_drift.rate": 5e-5}
    named = diagnose(nominal_plant(), recorded(drift, 8))
    assert [(c.effect, c.location) for c in named.causes] == [("coefficient_drift", "P32")]
    assert named.verdict == "named"
    denied = diagnose(nominal_plant(), recorded(drift, 8), settings=Settings(leave_out=("coefficient_drift",)))
    assert denied.where[0][0] == "P32" and denied.causes[0].effect != "coefficient_drift"


def test_a_second_effect_that_only_corrects_the_law_of_the_first_is_not_a_cause() -> None:
    """A pump with two equal poles: a lag, and a delay of a few percent of its influence on the readings."""
    commanded = recorded({}, 8).inputs
    step, delivered = torch.ones(len(commanded), dtype=torch.float64), commanded.clone()
    delivered[:, 0] = lagged(lagged(commanded[:, 0], step, 8.0), step, 8.0)
    recording = replace(recorded({}, 8, inputs=delivered, std=2e-4), inputs=commanded)
    answer = diagnose(nominal_plant(), recording)
    assert [(c.effect, c.location) for c in answer.causes] == [("pump_lag", "Q1")]


def test_an_effect_beside_an_unknown_is_found_though_the_unknown_hides_it() -> None:
    """A sensor whose gain changes at half of its range, beside a draw from another tank."""
    draw = {"T1.unmetered_flow.flow": 1.5e-5, "T1.unmetered_flow.begin": 300.0, "T1.unmetered_flow.duration": 300.0}
    recording = recorded(draw, 8, std=1e-4)
    readings = recording.outputs.clone()
    readings[:, 1] += 0.3 * (readings[:, 1] - readings[:, 1].median()).clamp(min=0.0)
    answer = diagnose(nominal_plant(), replace(recording, outputs=readings))
    assert {(c.effect, c.location) for c in answer.causes} == {("unmetered_flow", "T1"), ("unknown", "h2")}
