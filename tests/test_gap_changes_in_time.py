"""Changes in time at one place and at two, and a pump whose law is not in the library."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fdi_torch.gap.answer_assembly import amounts_of
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import standard_errors
from fdi_torch.gap.diagnose import Settings, diagnose, recalibrate
from fdi_torch.gap.problem import problem_of
from tests.test_gap import nominal_plant, recorded

LIBRARY = ("pump_gain", "pump_saturation", "coefficient_drift", "unmetered_flow", "leak", "flow_exponent")


def test_a_pump_whose_supply_runs_low_is_no_drift_of_the_outlet() -> None:
    """It delivers less the more it has pumped, nearly as a gain that falls."""
    told = recorded({}, 34, samples=600)
    assert told.inputs is not None
    pumped = torch.cumsum(told.inputs[:, 1], dim=0)
    share = torch.sqrt(1.0 - 0.35 * pumped / pumped[-1])
    spent = torch.stack([told.inputs[:, 0], told.inputs[:, 1] * share], dim=1)
    real = recorded({}, 34, samples=600, std=5e-4, inputs=spent)
    answer = diagnose(nominal_plant(), replace(real, inputs=told.inputs), settings=Settings(LIBRARY))
    assert answer.where[0][0] == "Q2" and answer.where[0][1] > 0.95
    assert all(
        effect != "coefficient_drift" for e in answer.posterior if e.probability > 0.01 for effect, _ in e.causes
    )


def test_two_changes_in_time_at_two_places_are_named() -> None:
    truth = {"T1.unmetered_flow.flow": -8e-6, "T1.unmetered_flow.begin": 180.0, "T1.unmetered_flow.duration": 210.0}
    truth |= {"P32.coefficient_drift.rate": -2.5e-4}
    answer = diagnose(nominal_plant(), recorded(truth, 32, samples=600), settings=Settings(LIBRARY))
    assert answer.verdict == "named"
    assert {(c.effect, c.location) for c in answer.causes} == {("unmetered_flow", "T1"), ("coefficient_drift", "P32")}


def test_a_leak_that_grows_is_named() -> None:
    truth = {"T1.leak.size": 0.3, "T1.leak.onset": 150.0, "T1.leak.ramp": 360.0}
    answer = diagnose(nominal_plant(), recorded(truth, 33, samples=600), settings=Settings(LIBRARY))
    assert answer.verdict == "named"
    (leak,) = answer.causes
    assert (leak.effect, leak.location) == ("leak", "T1")
    assert leak.parameters["onset"].value == pytest.approx(150.0, abs=5.0 * leak.parameters["onset"].std)
    assert leak.parameters["ramp"].value == pytest.approx(360.0, abs=5.0 * leak.parameters["ramp"].std)


@pytest.mark.parametrize(
    ("cause", "values"),
    [
        (("pump_gain", "Q1"), {"factor": 0.85, "onset": 180.0, "ramp": 240.0}),
        (("sensor_gain", "h1"), {"factor": 1.1, "onset": 240.0}),
        (("sensor_bias", "h2"), {"bias": 0.02, "onset": 210.0, "ramp": 180.0}),
    ],
)
def test_a_gain_or_bias_that_begins_in_mid_record_is_named(cause: tuple[str, str], values: dict[str, float]) -> None:
    truth = {f"{cause[1]}.{cause[0]}.{name}": value for name, value in values.items()}
    library = (*LIBRARY, "sensor_gain", "sensor_bias")
    answer = diagnose(nominal_plant(), recorded(truth, 34, samples=600), settings=Settings(library))
    assert answer.verdict == "named"
    (found,) = answer.causes
    assert (found.effect, found.location) == cause
    for name, value in values.items():
        assert found.parameters[name].value == pytest.approx(value, abs=5.0 * found.parameters[name].std)


def test_a_ramp_that_has_not_ended_is_told_by_the_size_that_it_has_reached() -> None:
    """Size and ramp cancel: only their ratio is known."""
    truth = {"T1.leak.size": 0.5, "T1.leak.onset": 180.0, "T1.leak.ramp": 840.0}
    recording = recorded(truth, 33, samples=600)
    answer = diagnose(nominal_plant(), recording, settings=Settings(("leak",), named_only=True))
    (leak,) = answer.causes
    onset, ramp, size = (leak.parameters[name] for name in ("onset", "ramp", "size"))
    assert onset.value + ramp.value == pytest.approx(599.0)
    assert size.value == pytest.approx(0.5 * 419.0 / 840.0, abs=4.0 * size.std) and size.std < 0.02


def test_a_change_at_the_very_end_of_the_recording_is_told_as_fitted() -> None:
    case = problem_of(nominal_plant(), (recorded({}, 1, samples=600),), (), Settings(("leak",)))
    fitter, null, _ = recalibrate(case.data)
    (placement,) = [p for p in case.library if p.location == "T1"]
    fitted = {"T1.leak.size": 0.3, "T1.leak.onset": 599.0}
    fit = fitter.fit(Candidate((placement,), (fitted,)), null, held=fitted)
    amounts = amounts_of(fitter, fit, placement, standard_errors(fitter, fit))
    assert {name: amount.value for name, amount in amounts.items()} == {"size": 0.3, "onset": 599.0}


def test_a_fault_from_the_start_at_the_floor_has_neither_onset_nor_height() -> None:
    """Both lower chi-square by chance; their prior widths cost more than that."""
    recording = recorded({"T1.leak.size": 0.3}, 1, samples=600)
    answer = diagnose(nominal_plant(), recording, settings=Settings(("leak@T1",), named_only=True))
    (leak,) = answer.causes
    assert leak.parameters.keys() == {"size"}


def test_a_fault_that_begins_soon_keeps_its_onset() -> None:
    truth = {"P32.plugging.size": 0.3, "P32.plugging.onset": 20.0}
    recording = recorded(truth, 1, samples=600)
    answer = diagnose(nominal_plant(), recording, settings=Settings(("plugging@P32",), named_only=True))
    (plugging,) = answer.causes
    onset = plugging.parameters["onset"]
    assert onset.value == pytest.approx(20.0, abs=4.0 * onset.std)


def test_a_parameter_that_the_readings_do_not_show_is_known_no_better_than_its_range() -> None:
    """A flow that has not ended when the recording does may last any time."""
    truth = {"T1.unmetered_flow.flow": -8e-6, "T1.unmetered_flow.begin": 200.0, "T1.unmetered_flow.duration": 900.0}
    case = problem_of(nominal_plant(), (recorded(truth, 1, samples=600),), (), Settings(("unmetered_flow",)))
    fitter, null, _ = recalibrate(case.data)
    (placement,) = [p for p in case.library if p.location == "T1"]
    fit = fitter.fit(Candidate((placement,), ({**truth, "T1.unmetered_flow.duration": 599.0},)), null)
    errors = standard_errors(fitter, fit)
    low, high, _ = fitter.box(fit.space)
    i = fit.space.index("T1.unmetered_flow.duration")
    assert errors["T1.unmetered_flow.duration"] == pytest.approx(float(high[i] - low[i]) / 12.0**0.5)
    begin = "T1.unmetered_flow.begin"
    assert 0.1 < errors[begin] < 2.0 and abs(fit.values[begin] - 200.0) < 4.0 * errors[begin]
