"""Closure on hold-outs, reference models, curves and remarks, on rigs with known causes."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
import torch

from fdi_torch.effects import placements_for
from fdi_torch.gap.answer import Answer
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.holdout import HeldOut, Model, closure, run_reference_models, transferable_values
from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlacedEffect
from fdi_torch.recording import Recording
from tests.rigs import blank_recording, three_tank
from tests.test_gap import noise, nominal_plant, recorded

LAMINAR = {"P13.laminar_flow.transition_head": 0.05}
LIBRARY = ("laminar_flow", "pump_lag", "leak")


def recordings() -> tuple[Recording, list[Recording]]:
    """A laminar pipe, and two hold-outs of the same rig with other inputs, one of them noisier."""
    holdouts = [recorded(LAMINAR, 5, samples=500), recorded(LAMINAR, 7, samples=700, std=2e-3)]
    return recorded(LAMINAR, 3, samples=600), [replace(h, source=f"day{k}.csv") for k, h in enumerate(holdouts, 1)]


@pytest.fixture(scope="module")
def answer() -> Answer:
    recording, holdouts = recordings()
    return diagnose(nominal_plant(), recording, holdouts, Settings(LIBRARY))


def test_hold_outs_count_together_and_one_by_one(answer: Answer) -> None:
    closure = answer.closure
    assert closure["holdouts"] == ["day1.csv", "day2.csv"]
    first, second = closure["per_holdout"]
    assert first["augmented"] == pytest.approx(0.1, rel=0.1) and second["augmented"] == pytest.approx(0.2, rel=0.1)
    for model in ("nominal", "recalibrated", "augmented", "ceiling", "noise_floor"):
        pooled = (500 * first[model] ** 2 + 700 * second[model] ** 2) / 1200
        assert closure[model] ** 2 == pytest.approx(pooled, rel=1e-9)
    assert closure["closed"] == pytest.approx(1.0, abs=0.02)


def test_the_ceiling_is_no_worse_than_the_right_effect(answer: Answer) -> None:
    closure = answer.closure
    assert closure["ceiling_at"] == ["P13"]
    assert closure["ceiling"] == pytest.approx(closure["augmented"], rel=0.02)
    assert closure["recalibrated"] > 1.5 * closure["augmented"]


def test_a_cause_absorbed_by_recalibration_counts_twice_with_frozen_constants(answer: Answer) -> None:
    constant = answer.constants["P13.discharge_coefficient"]
    assert constant["recalibrated"] < 0.585 < 0.59 < constant["augmented"] < 0.61
    frozen = answer.closure["frozen"]
    assert frozen["recalibrated"] > 2.0 * answer.closure["augmented"]
    # The rig has nominal constants. The cause was fitted beside the coefficient, whose error (2 %) it has taken up.
    assert answer.closure["augmented"] <= frozen["nominal"] < frozen["recalibrated"]


def test_the_free_curve_finds_the_effect_that_is_there(answer: Answer) -> None:
    by_head, by_time = answer.curves
    assert (by_head["location"], by_head["variable"], by_time["variable"]) == ("P13", "T1 − T3", "time")
    assert (by_head["quantity"], by_head["quantity_unit"]) == ("flow", "m^3/s")
    free, std, effect = (torch.tensor(by_head[name]) for name in ("free", "free_std", "effect"))
    assert bool(((free - effect).abs() < 5.0 * std + 0.03 * effect.abs().max()).all())
    # Hagen-Poiseuille at low heads: less flow than the square root law has, by up to a part of the flow itself.
    assert bool((effect < 0.0).all()) and float(effect.min()) < -3e-6


def test_a_free_form_of_local_variables_closes_part_of_the_gap_on_a_hold_out() -> None:
    recording, holdout = recorded(LAMINAR, 3, samples=600), recorded(LAMINAR, 5, samples=400)
    answer = diagnose(nominal_plant(), recording, holdout, Settings(("pump_lag", "sensor_gain@h2")))
    assert answer.verdict == "unknown" and answer.where[0][0] == "P13"
    assert answer.closure["closed"] > 0.8
    assert answer.closure["ceiling"] == pytest.approx(answer.closure["augmented"])


def test_the_mean_of_a_time_function_transfers_and_sinusoids_do_not() -> None:
    form = {"head_0": 0.1, "time_0": 0.2, "time_1": 0.4, "sine_0": 0.3, "cosine_0": 0.3}
    values = {f"P13.free_flow.{name}": value for name, value in form.items()} | {"Q1.pump_gain.time_0": 5.0}
    carried = transferable_values(values)
    expected = {"head_0": 0.1, "time_0": 0.3, "time_1": 0.3, "sine_0": 0.0, "cosine_0": 0.0}
    assert {n.removeprefix("P13.free_flow."): v for n, v in carried.items() if "P13" in n} == pytest.approx(expected)
    assert carried["Q1.pump_gain.time_0"] == 5.0, "no free form's"


def test_the_noise_of_a_hold_out_is_right_even_if_the_augmented_model_diverges() -> None:
    held = data_set_of(nominal_plant(), (), recorded({}, 5, samples=600), 1.0)
    white = Noise(torch.full((3,), 1e-3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    swinging = {"h1.sensor_oscillation.amplitude": 0.05, "h1.sensor_oscillation.period": 5.0}
    models = {"recalibrated": Model(), "augmented": Model(placements_for(swinging), swinging)}
    found = run_reference_models(held, white, models, [0.0, 0.0, 0.0])
    assert found.squares["augmented"].sum() > 1.5 * found.squares["recalibrated"].sum()
    assert found.noise.std.tolist() == pytest.approx([1e-3] * 3, rel=0.1)


def held_out(gap: float, ar: float, samples: int = 6000) -> HeldOut:
    """Readings of the augmented model with AR(1) noise of 1 mm; the recalibrated model is off by `gap`, m."""
    plant, time = nominal_plant(), torch.arange(samples, dtype=torch.float64)
    zero = torch.zeros(samples, 3, dtype=torch.float64)
    blank = blank_recording(plant, zero[:, :2], time)
    recording = replace(blank, outputs=noise(samples, ar, 1e-3, 9), mask=None)  # type: ignore[arg-type]
    runs = {"recalibrated": zero + gap, "augmented": zero}
    each = torch.full((3,), ar, dtype=torch.float64)
    return HeldOut(data_set_of(plant, (), recording, 1.0), runs, Noise(1e-3 * torch.sqrt(1.0 - each**2), each))


@pytest.mark.parametrize("ar", [0.0, 0.9])
def test_the_closed_share_is_as_certain_as_the_mean_square_of_correlated_noise(ar: float) -> None:
    """Bartlett (1946): sum e^2 of n samples of AR(1) noise has the variance 2 n s^4 (1 + a^2) / (1 - a^2)."""
    gap, samples = 1e-3, 6000
    told = closure([held_out(gap, ar, samples)])
    assert told.closed is not None and told.closed_ci95 is not None
    noise_error = math.sqrt(2.0 * 3 * samples * (1.0 + ar**2) / (1.0 - ar**2)) * 1e-6
    assert 1.0 - told.closed_ci95[0] == pytest.approx(1.96 * noise_error / (3 * samples * gap**2), rel=0.25)


def test_a_gap_of_less_than_five_standard_errors_has_no_closed_share() -> None:
    """A gap g of n readings with white noise s: the sum of squares n g^2 has the standard error 2 g s sqrt(n)."""
    for errors, closed in ((3.0, None), (8.0, 1.0)):
        assert closure([held_out(2.0 * errors * 1e-3 / math.sqrt(18000), 0.0)]).closed == closed


def test_causes_that_make_a_hold_out_without_a_gap_worse_close_less_than_nothing() -> None:
    """As where the hold-out is older than the fault."""
    held = held_out(0.05, 0.0)
    runs = {"recalibrated": held.runs["augmented"], "augmented": held.runs["recalibrated"]}
    told = closure([replace(held, runs=runs)])
    assert told.closed == -9.0 and told.closed_ci95 == (-9.0, -9.0)


def test_arrays_of_all_models_are_there_for_the_page(answer: Answer) -> None:
    arrays = answer.arrays
    assert arrays["augmented"].shape == arrays["nominal"].shape == (600, 3)
    assert arrays["holdout_time"].shape == (500,) and arrays["holdout_2_read"].shape == (700, 3)
    left = arrays["holdout_2_read"] - arrays["holdout_2_augmented"]
    assert float(left.std()) == pytest.approx(2e-3, rel=0.1)


def test_a_hold_out_of_another_rig_is_reported_with_the_constants_that_differ() -> None:
    recording = recorded(LAMINAR, 3, samples=600)
    same = replace(recorded(LAMINAR, 5, samples=600), source="same.csv")
    other = replace(recorded({**LAMINAR, "P32.discharge_coefficient": 0.5}, 5, samples=600), source="other.csv")
    settings = Settings(("laminar_flow@P13",), named_only=True)
    answer = diagnose(nominal_plant(), recording, [same, other], settings)
    (remark,) = answer.remarks
    needed = r"other.csv needs other constants than the recording \(P32.discharge_coefficient 0\.(49|50)"
    assert re.match(needed, remark)
    assert "of another rig" in remark


def test_a_hold_out_that_asks_a_pump_for_more_than_it_delivers_is_doubted() -> None:
    recording = recorded(LAMINAR, 3, samples=200)
    other = recorded(LAMINAR, 5, samples=200)
    inputs = other.inputs.clone()
    inputs[100:110, 0] = -1e-5
    inputs[110:120, 0] = 3e-4
    holdout = replace(other, inputs=inputs, source="control.csv")
    answer = diagnose(nominal_plant(), recording, holdout, Settings(("laminar_flow@P13",), named_only=True))
    doubts = [remark for remark in answer.remarks if remark.startswith("control.csv: Q1: asks for")]
    assert len(doubts) == 2 and "up to 300 cm^3/s of Q1" in doubts[0] and "negative flow" in doubts[1]


def test_a_hold_out_with_a_further_cause_is_reported() -> None:
    recording = recorded(LAMINAR, 3, samples=600)
    other = recorded({**LAMINAR, "h2.sensor_lag.time_constant": 60.0}, 5, samples=600)
    settings = Settings(("laminar_flow@P13",), named_only=True)
    answer = diagnose(nominal_plant(), recording, replace(other, source="other.csv"), settings)
    assert any("does not explain other.csv, whatever the constants" in remark for remark in answer.remarks)


@pytest.mark.parametrize("source", ["same", "copy", "overlap"])
def test_a_recording_cannot_be_its_own_hold_out(source: str) -> None:
    recording = recorded(LAMINAR, 3, samples=100)
    holdout = (
        recording if source == "same" else replace(recording, source="copy.csv", outputs=recording.outputs.clone())
    )
    if source == "overlap":
        recording, holdout = replace(recording, sha256="ab"), replace(short(holdout, 80), sha256="ab")
    with pytest.raises(ValueError, match="expected a hold-out other than the recording"):
        diagnose(nominal_plant(), recording, holdout)


def short(recording: Recording, samples: int) -> Recording:
    part = slice(0, samples)
    kept = {name: getattr(recording, name)[part] for name in ("time", "inputs", "outputs", "mask")}
    return replace(recording, **kept)


def test_a_recording_too_short_is_refused_in_one_sentence() -> None:
    recording = replace(recorded(LAMINAR, 3, samples=200), source="run.csv")
    with pytest.raises(ValueError, match=r"run.csv: expected at least 60 readings of every sensor, got 40 of h1"):
        diagnose(nominal_plant(), short(recording, 40))
    with pytest.raises(ValueError, match="got 40 of h1"):
        diagnose(nominal_plant(), recording, short(recording, 40), Settings(("leak@T1",)))


@pytest.mark.parametrize(
    ("columns", "value", "sentence"),
    [
        ((1,), math.nan, "run.csv: expected at least 60 readings of every sensor, got 0 of h2"),
        ((0, 1, 2), math.nan, "run.csv: expected at least 60 readings of every sensor, got 0 of h1"),
        ((0, 1, 2), 0.3, "run.csv: expected readings that vary, got one value of each sensor throughout"),
    ],
)
def test_readings_that_are_missing_or_constant_are_refused(
    columns: tuple[int, ...], value: float, sentence: str
) -> None:
    run = short(recorded({}, 3, samples=70), 60)
    outputs = run.outputs.clone()
    outputs[:, columns] = value
    with pytest.raises(ValueError, match=sentence):
        diagnose(nominal_plant(), replace(run, source="run.csv", outputs=outputs, mask=torch.isfinite(outputs)))


def test_an_unknown_input_is_refused_in_one_sentence() -> None:
    recording = recorded(LAMINAR, 3, samples=200)
    inputs = recording.inputs.clone()
    inputs[50:60, 1] = torch.nan
    with pytest.raises(ValueError, match="expected a value of every input, got a missing one at 50 s"):
        diagnose(nominal_plant(), replace(recording, inputs=inputs))


def test_a_library_that_names_a_place_the_plant_lacks_is_refused() -> None:
    with pytest.raises(ValueError, match=r"expected a place of plant three_tank \(T1, .*\), got 'Q9'"):
        diagnose(nominal_plant(), recorded(LAMINAR, 3, samples=100), settings=Settings(("pump_lag@Q9",)))


def test_a_plant_without_tolerances_is_reported() -> None:
    answer = diagnose(three_tank(), recorded(LAMINAR, 3, samples=300), settings=Settings(("laminar_flow",)))
    assert any("lists no tolerances" in remark for remark in answer.remarks) and not answer.constants


def test_a_plant_file_with_an_effect_outside_its_range_is_reported() -> None:
    lag = {"time_constant": 400.0}
    slow = replace(nominal_plant(), effects=(PlacedEffect("pump_lag", "Q1", lag),))
    recording = recorded({f"Q1.pump_lag.{name}": value for name, value in lag.items()}, 3, samples=300)
    answer = diagnose(slow, recording, settings=Settings(("leak",)))
    assert any("Q1.pump_lag.time_constant at 400 s, outside its sensible range" in r for r in answer.remarks)


def test_constant_inputs_are_reported_and_nothing_within_tolerance_is_named() -> None:
    recording = recorded({"OUT2.plugging.size": 0.06, "P13.discharge_coefficient": 0.6}, 3, samples=600, steady=True)
    answer = diagnose(nominal_plant(), recording, settings=Settings(("plugging", "pump_gain", "leak", "sensor_bias")))
    assert any("inputs never change" in remark for remark in answer.remarks)
    assert answer.verdict in ("no_gap", "ambiguous")
    assert answer.excitation["hidden"] or answer.excitation["inseparable"]


def test_a_parameter_at_the_bound_of_its_range_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    from fdi_torch.effects.laminar_flow import LaminarFlow

    def narrow(self: LaminarFlow, place: str, plant: object) -> tuple[Parameter, ...]:
        return (Parameter("transition_head", "m", 0.0, 0.0, 0.045), Parameter("softness", "1", 0.5, 0.17, 0.5))

    monkeypatch.setattr(LaminarFlow, "parameters", narrow)
    answer = diagnose(
        nominal_plant(),
        recorded({"P13.laminar_flow.transition_head": 0.05}, 3),
        settings=Settings(("laminar_flow@P13",), named_only=True),
    )
    assert any("is at the bound of its sensible range (4.5 cm)" in remark for remark in answer.remarks)


def test_an_unknown_oscillation_is_reported_with_its_period() -> None:
    truth = {"Q1.pump_oscillation.amplitude": 0.1, "Q1.pump_oscillation.period": 90.0}
    answer = diagnose(nominal_plant(), recorded(truth, 3), settings=Settings(("sensor_gain@h2",)))
    assert answer.verdict == "unknown" and answer.where[0][0] == "Q1"
    (remark,) = [r for r in answer.remarks if "oscillates" in r]
    period = float(remark.split("period of ")[1].split(" s")[0])
    assert period == pytest.approx(90.0, rel=0.03)  # the grid of periods is 5 % wide
    assert answer.curves[0]["variable"].startswith("time within each")


def test_a_free_form_that_fails_on_a_hold_out_is_reported() -> None:
    """A lag without its name: a function of what the pump sees now does not carry over."""
    lag = {"Q1.pump_lag.time_constant": 15.0}
    answer = diagnose(
        nominal_plant(), recorded(lag, 41, samples=500), recorded(lag, 42, samples=300), Settings(("pump_gain",))
    )
    assert answer.verdict == "unknown" and answer.closure["augmented"] > answer.closure["recalibrated"]
    assert any("unknown discrepancy at Q1 predicts memory worse than" in said for said in answer.remarks)


def test_errors_of_sensors_with_several_units_are_pooled_in_standard_deviations_of_noise(answer: Answer) -> None:
    plant, volts = nominal_plant(), 20.0  # a metre of level
    mixed = replace(plant, sensors=(*plant.sensors[:2], replace(plant.sensors[2], unit="V", gain=volts)))

    def in_volts(r: Recording) -> Recording:
        return replace(r, outputs=r.outputs * torch.tensor([1.0, 1.0, volts]), output_units=("m", "m", "V"))

    recording, holdouts = recordings()
    alike, settings = answer.closure, Settings(("laminar_flow@P13",), named_only=True)
    closure = diagnose(mixed, in_volts(recording), [in_volts(h) for h in holdouts], settings).closure
    assert alike["unit"] == "cm" and closure["unit"] == "noise levels"
    assert list(closure["units"].values()) == ["cm", "cm", "V"]
    assert closure["noise_floor"] == pytest.approx(1.0, rel=1e-9)
    assert closure["augmented"] == pytest.approx(1.0, abs=0.05)
    in_cm = alike["per_sensor"]["h3"]["recalibrated"]
    assert closure["per_sensor"]["h3"]["recalibrated"] == pytest.approx(
        volts * 1e-2 * in_cm, rel=5e-3
    )  # fits end within a hundredth of a nat
    assert closure["closed"] == pytest.approx(1.0, abs=0.02)
