"""Prior odds, and normalised probabilities."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from fdi_torch.effects import placements_for
from fdi_torch.estimate.evidence import ODDS, log_odds_of_law, posterior
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.cause_hypothesis import CauseHypothesis, influence
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.diagnose import Settings, diagnose, is_sure, verdict_of
from fdi_torch.gap.localization.regressors import lagged
from fdi_torch.gap.marginal_likelihood import log_evidence, log_prior
from fdi_torch.gap.posterior import Posterior
from tests.rigs import three_tank
from tests.test_gap import nominal_plant, recorded

SAMPLES = 600  # of the recordings that are searched with the whole library


def test_all_sets_of_effects_of_one_size_share_one_prior() -> None:
    """How many effects a library holds is no evidence for there being several."""
    choices = 7
    one, two = (log_prior([("any", place) for place in places], choices) for places in (["T1"], ["T1", "T2"]))
    assert math.exp(one) * choices == pytest.approx(ODDS.effect)
    assert math.exp(two) * choices**2 / 2 == pytest.approx(ODDS.effect**2), "a set has no order"


def test_two_effects_at_one_place_are_less_likely_than_at_two() -> None:
    apart, together = (log_prior([("leak", "T1"), ("area_taper", place)], 7) for place in ("T2", "T1"))
    assert apart - together == pytest.approx(-math.log(ODDS.same_place))


def test_all_errors_of_a_law_together_have_the_prior_odds_of_an_effect_with_an_inexact_law() -> None:
    """Differences of another law are uniform up to two: the mean of the odds over them is that of the priors."""
    choices, places, errors = 7, 5, torch.linspace(0.0, 2.0, 20001).tolist()
    odds = [math.exp(log_odds_of_law(error, choices, places)) for error in errors]
    prior = ODDS.inexact * (ODDS.effect / choices) / (ODDS.unknown / places)
    assert sum(odds) / len(odds) == pytest.approx(prior, rel=1e-3)
    exact = math.exp(log_odds_of_law(None, choices, places))
    assert odds[0] / exact == pytest.approx(ODDS.inexact / (1.0 - ODDS.inexact))


def test_probabilities_follow_from_differences_of_logarithms_alone() -> None:
    for shift in (0.0, 1e6, -1e6):
        assert posterior([shift + math.log(3.0), shift]) == pytest.approx([0.75, 0.25], rel=1e-6)


def white(std: float) -> Noise:
    return Noise(torch.full((3,), std, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


def test_a_constant_that_could_have_been_anywhere_in_twice_the_range_halves_the_evidence() -> None:
    """Occam's factor of a constant that the recording determines far better than its tolerance does."""
    recording, told = recorded({}, 3, samples=300), []
    for tolerance in (0.05, 0.1):
        plant = replace(three_tank(), tolerances={"P13.discharge_coefficient": tolerance})
        fitter = Fitter(data_set_of(plant, (), recording, 1.0), white(1e-3))
        told.append(log_evidence(fitter, fitter.fit(Candidate()), 7))
    assert told[0] - told[1] == pytest.approx(math.log(2.0), abs=0.02)


def test_noise_of_twice_the_size_has_the_evidence_of_its_normal_density() -> None:
    """N readings lose log 2 each, but for the three initial levels that are estimated from them."""
    data, told = data_set_of(three_tank(), (), recorded({}, 3, samples=300), 1.0), []
    for std in (1e-3, 2e-3):
        fitter = Fitter(data, white(std))
        fit = fitter.fit(Candidate())
        told.append(log_evidence(fitter, fit, 7) + 0.5 * fit.cost)
    assert told[0] - told[1] == pytest.approx((900 - 3) * math.log(2.0), abs=0.02)


def test_no_gap_needs_95_percent_as_any_other_verdict() -> None:
    evaluated: Any = None
    nothing, leak = CauseHypothesis(evaluated, (), 0.0), CauseHypothesis(evaluated, (("leak", "T1"),), -2.0)
    assert verdict_of([nothing], True, []) == "no_gap"
    assert verdict_of([nothing, leak], False, []) == "ambiguous"
    assert verdict_of([nothing, leak], False, [("unknown", "h1")]) == "unknown"
    assert verdict_of([leak], True, []) == "named"


def test_causes_are_named_only_by_a_fit_that_has_converged() -> None:
    for converged in (True, False):
        explanation: Any = SimpleNamespace(fit=SimpleNamespace(converged=converged))
        leak, nothing = (CauseHypothesis(explanation, causes, 0.0) for causes in ((("leak", "T1"),), ()))
        assert is_sure(Posterior((leak,), (0.96,), 0.04, ())) is converged
        assert is_sure(Posterior((nothing,), (0.96,), 0.04, ())), "nothing is named"
        assert not is_sure(Posterior((leak, nothing), (0.94, 0.06), 0.0, ()))


@pytest.mark.slow
def test_an_unknown_that_an_effect_at_its_place_predicts_as_well_is_that_effect() -> None:
    """A ramp in time of a pipe's flow is one regressor of an unknown, and two parameters of a drifting coefficient."""
    recording = recorded({"P32.coefficient_drift.rate": 8e-5}, 8, samples=SAMPLES)
    named = diagnose(nominal_plant(), recording)
    assert [(c.effect, c.location) for c in named.causes] == [("coefficient_drift", "P32")]
    assert named.verdict == "named"
    denied = diagnose(nominal_plant(), recording, settings=Settings(leave_out=("coefficient_drift",)))
    assert denied.where[0][0] == "P32" and denied.causes[0].effect != "coefficient_drift"


@pytest.mark.slow
def test_a_second_effect_that_only_corrects_the_law_of_the_first_is_not_a_cause() -> None:
    """A pump with two equal poles: a lag, and a delay of a few percent of its influence on the readings."""
    commanded = recorded({}, 8, samples=SAMPLES).inputs
    step, delivered = torch.ones(len(commanded), dtype=torch.float64), commanded.clone()
    delivered[:, 0] = lagged(lagged(commanded[:, 0], step, 8.0), step, 8.0)
    recording = replace(recorded({}, 8, samples=SAMPLES, inputs=delivered, std=2e-4), inputs=commanded)
    answer = diagnose(nominal_plant(), recording)
    assert [(c.effect, c.location) for c in answer.causes] == [("pump_lag", "Q1")]


@pytest.mark.slow
def test_an_effect_whose_law_is_slightly_wrong_is_likelier_than_an_unknown() -> None:
    """A draw that opens and closes in 20 s; the library's begins and ends at once.

    It differs by 2 %, as few true effects and few other laws do: it is likelier, but not certain.
    """
    commanded = recorded({}, 8, samples=SAMPLES).inputs
    time, net = torch.arange(len(commanded), dtype=torch.float64), commanded.clone()
    net[:, 0] -= 1.5e-5 * (((time - 250.0) / 20.0).clamp(0.0, 1.0) - ((time - 520.0) / 20.0).clamp(0.0, 1.0))
    recording = recorded({}, 8, samples=SAMPLES, inputs=net, std=2e-4)
    answer = diagnose(nominal_plant(), replace(recording, inputs=commanded))
    assert [(c.effect, c.location) for c in answer.causes] == [("unmetered_flow", "T1")]
    assert answer.verdict == "ambiguous" and answer.to_dict()["posterior"][0]["probability"] > 0.5


def test_the_influence_of_an_effect_is_the_chi_square_that_a_fit_without_it_adds() -> None:
    """For an effect in which the readings are linear; with exact constants, only the initial levels can replace it."""
    recording = recorded({"h3.sensor_drift.rate": 2e-6}, 3, samples=600)
    fitter = Fitter(data_set_of(three_tank(), (), recording, 1.0), white(1e-3))
    drift = placements_for({"h3.sensor_drift.rate": 2e-6})
    null = fitter.fit(Candidate())
    fit = fitter.fit(Candidate(tuple(drift), ({"h3.sensor_drift.rate": 0.0},)), null)
    assert influence(fitter, fit, [("sensor_drift", "h3")]) ** 2 == pytest.approx(null.cost - fit.cost, rel=0.01)


@pytest.mark.slow
def test_effects_that_only_compensate_a_sensor_that_jumps_are_not_causes() -> None:
    """A sensor reads 6.5 mm too little for five minutes, beside a weak pump: plugged pipes and a bias were named."""
    recording = recorded({"Q1.pump_gain.factor": 0.85}, 8, samples=SAMPLES, std=2e-4)
    readings = recording.outputs.clone()
    readings[200:500, 2] -= 0.0065
    answer = diagnose(nominal_plant(), replace(recording, outputs=readings))
    assert [(c.effect, c.location) for c in answer.causes] == [("pump_gain", "Q1"), ("unknown", "h3")]


@pytest.mark.slow
def test_a_random_discrepancy_that_exceeds_an_effect_is_no_error_of_its_law() -> None:
    """A sensor whose clock runs unevenly, beside a leak: a lag or a delay of it describes the mean lateness only."""
    recording = recorded({"T1.leak.size": 0.2}, 3, samples=SAMPLES, std=2e-4)
    samples, late = len(recording.outputs), 0.0
    shocks = 0.6 * torch.randn(samples, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    readings, level = recording.outputs.clone(), recording.outputs[:, 1]
    for k in range(1, samples):
        late = 0.98 * late + float(shocks[k])
        at = max(k - abs(late), 0.0)
        before, share = int(at), at - int(at)
        readings[k, 1] = (1.0 - share) * level[before] + share * level[min(before + 1, samples - 1)]
    answer = diagnose(nominal_plant(), replace(recording, outputs=readings))
    assert [(c.effect, c.location) for c in answer.causes] == [("leak", "T1"), ("unknown", "h2")]


@pytest.mark.slow
def test_an_effect_beside_an_unknown_is_found_though_the_unknown_hides_it() -> None:
    """A sensor whose gain changes at half of its range, beside a draw from another tank."""
    draw = {"T1.unmetered_flow.flow": 1.5e-5, "T1.unmetered_flow.begin": 200.0, "T1.unmetered_flow.duration": 200.0}
    recording = recorded(draw, 8, samples=SAMPLES, std=1e-4)
    readings = recording.outputs.clone()
    readings[:, 1] += 0.3 * (readings[:, 1] - readings[:, 1].median()).clamp(min=0.0)
    answer = diagnose(nominal_plant(), replace(recording, outputs=readings))
    assert {(c.effect, c.location) for c in answer.causes} == {("unmetered_flow", "T1"), ("unknown", "h2")}


@pytest.mark.slow
def test_a_pump_that_stalls_once_beside_another_cause_is_no_draw_from_its_tank() -> None:
    """Its stop has the times and the size of a draw, but these three numbers are those of its command."""
    generator = torch.Generator().manual_seed(11)
    command = (25e-6 + 45e-6 * torch.rand(9, 2, generator=generator, dtype=torch.float64)).repeat_interleave(70, dim=0)
    command[350:420, 0] = 20e-6
    delivered = command.clone()
    delivered[350:420, 0] = 0.0
    recording = recorded({"h2.sensor_lag.time_constant": 20.0}, 9, samples=630, inputs=delivered)
    answer = diagnose(nominal_plant(), replace(recording, inputs=command))
    assert {(c.effect, c.location) for c in answer.causes} == {("sensor_lag", "h2"), ("unknown", "Q1")}


@pytest.mark.slow
def test_a_lag_in_place_of_a_delay_that_the_library_lacks_is_not_certain() -> None:
    """The two differ by about 15 % of their influence, more than most errors of a law."""
    recording = recorded({"Q1.pump_delay.delay": 7.0}, 3, samples=SAMPLES, std=2e-4)
    answer = diagnose(nominal_plant(), recording, settings=Settings(leave_out=("pump_delay",)))
    assert answer.verdict != "named"
    likeliest = answer.to_dict()["posterior"][:2]
    assert {c["location"] for h in likeliest for c in h["causes"]} == {"Q1"}
