"""Identifiability: simulated confusions, inseparable effects, and the input that separates two rivals."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from fdi_torch.effects import build_network, effect, placements_for
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.experiment_design import LARGEST_COMMAND, discriminating_input, planned_recording
from fdi_torch.gap.identifiability import (
    DRAWS,
    exact_areas_like,
    identifiability,
    simulated_confusions,
    unsearched_equivalents,
)
from fdi_torch.gap.problem import checked_data_set
from fdi_torch.gap.screening import Option, Pairs, options_of, screen
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of
from fdi_torch.simulate.simulated_recording import clean_readings
from tests.rigs import constant_inputs, draining_tanks, three_tank
from tests.test_gap import nominal_plant, recorded


def made_up(columns: torch.Tensor) -> Pairs:
    """Pairs of three pump gains, as if they had these columns."""
    places = ("Q1", "Q2", "Q1")
    names = ("pump_gain", "pump_gain", "pump_lag")
    options = []
    for name, place in zip(names, places, strict=True):
        kind = effect(name)
        parameters = kind.parameters(place, nominal_plant())
        size = parameters[0]
        start = {f"{place}.{name}.{size.name}": size.nominal + 1e-3 * (size.high - size.nominal)}
        options.append(Option(Placement(kind, place), start, parameters))
    return Pairs(tuple(options), torch.zeros(3, dtype=torch.float64), columns.T @ columns)


def test_a_collinear_cause_is_confused_half_the_time_and_always_without_the_true_cause() -> None:
    # The first two columns are one and the same but for a ten-thousandth; the third has nothing to do with them.
    columns = torch.zeros(4, 3, dtype=torch.float64)
    columns[0, :2], columns[1, 1], columns[2, 2] = 30.0, 3e-3, 30.0
    told = simulated_confusions(made_up(columns), ("pump_gain", "Q1"), 900.0, nominal_plant())
    assert told is not None
    assert told["rivals"] == 2 and told["draws"] == 2 * DRAWS
    assert told["passed"] == DRAWS and told["passed_for"] == [{"effect": "pump_gain", "location": "Q2"}]
    assert 0.2 * DRAWS < told["confused"] < 0.8 * DRAWS


def test_effects_with_different_signatures_are_never_confused() -> None:
    told = simulated_confusions(
        made_up(30.0 * torch.eye(3, dtype=torch.float64)), ("pump_gain", "Q1"), 900.0, nominal_plant()
    )
    assert told is not None and told["passed"] == told["confused"] == 0


def test_a_gap_that_no_other_effect_can_cause_is_not_confused() -> None:
    pairs = made_up(1e-2 * torch.eye(3, dtype=torch.float64))
    assert simulated_confusions(pairs, ("pump_gain", "Q1"), 1e9, nominal_plant()) is None


def test_an_effect_that_a_calibrated_constant_absorbs_shows_nothing() -> None:
    """The gain of the first pump is all but unknown, that of the second is given."""
    plant = replace(three_tank(), tolerances={"Q1.gain": 100.0})
    noise = Noise(torch.full((3,), 1e-3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    fitter = Fitter(data_set_of(plant, (), recorded({}, 3, samples=200), 1.0), noise)
    gains = [Placement(effect("pump_gain"), pump) for pump in ("Q1", "Q2")]
    options = [Option(p, {p.full_name("factor"): 1.01}) for p in gains]
    absorbed, shown = screen(fitter, fitter.fit(Candidate()), options).strength.tolist()
    assert absorbed < 1e-3 * shown


def test_inseparable_and_hidden_effects_follow_from_the_columns() -> None:
    columns = torch.zeros(4, 3, dtype=torch.float64)
    columns[0, :2], columns[1, 1], columns[2, 2] = 30.0, 3.0, 4.0
    pairs = made_up(columns)
    found = identifiability(pairs, nominal_plant())
    assert found.hidden == (("pump_lag", "Q1"),)
    ((first, second, left),) = found.inseparable
    assert {first, second} == {("pump_gain", "Q1"), ("pump_gain", "Q2")}
    # What is left of the weaker beside the stronger: |a|^2 sin^2 of the angle between them.
    assert left == pytest.approx(900.0 * math.sin(math.atan2(3.0, 30.0)) ** 2)


@pytest.fixture(scope="module")
def rivals() -> Fitter:
    """A recording under steady inputs: lag and delay of a pump are one there."""
    recording = recorded({"Q1.pump_lag.time_constant": 10.0}, 9, samples=300, steady=True)
    white = Noise(torch.full((3,), 1e-3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    return Fitter(checked_data_set(nominal_plant(), (), [recording], None), white)


def test_the_designed_input_separates_what_the_recording_cannot(rivals: Fitter) -> None:
    fits = [
        rivals.fit(Candidate((Placement(effect(name), "Q1"),), ({f"Q1.{name}.{size}": 10.0},)))
        for name, size in (("pump_lag", "time_constant"), ("pump_delay", "delay"))
    ]
    assert abs(fits[0].cost - fits[1].cost) < 10.0
    found = discriminating_input(rivals, fits[0], fits[1])
    assert found is not None and found["separation"] > 20.0
    assert found["parted_after_samples"] == round(found["parted_after"]) + 1 < 1500
    wanted = planned_recording(found["input"], nominal_plant())
    assert wanted.input_names == ("Q1", "Q2") and len(wanted) == 1500
    full = torch.tensor([p.max_flow for p in nominal_plant().pumps], dtype=torch.float64)
    assert bool((wanted.inputs > 0.0).all()) and bool((wanted.inputs <= LARGEST_COMMAND * full).all())
    held = torch.diff(wanted.inputs[:, 0]).abs()
    assert int((held > 0).sum()) == len(found["input"]["Q1"]["at"]) - 1


@pytest.mark.parametrize(("dead_zone", "twins"), [(8e-6, (("pump_offset", "Q1"),)), (30e-6, ())])
def test_a_dead_zone_below_all_commands_has_an_offset_as_twin(
    dead_zone: float, twins: tuple[tuple[str, str], ...]
) -> None:
    """All commands are above 15 cm3/s."""
    name = "Q1.pump_dead_zone.dead_zone"
    white = Noise(torch.full((3,), 1e-3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    fitter = Fitter(checked_data_set(nominal_plant(), (), [recorded({name: dead_zone}, 9)], None), white)
    placed = Placement(effect("pump_dead_zone"), "Q1")
    fit = fitter.fit(Candidate((placed,), ({name: dead_zone},)))
    offsets = [Placement(effect("pump_offset"), pump) for pump in ("Q1", "Q2")]
    reach = operating_range_of(fitter.data.recording, nominal_plant())
    assert unsearched_equivalents(fitter, fit, placed, options_of(offsets, fitter, reach), 0.95) == twins


def test_a_cross_section_that_counts_as_exact_explains_what_a_taper_does() -> None:
    white = Noise(torch.full((3,), 1e-3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    area = nominal_plant().tank("T3").area
    fitter = Fitter(checked_data_set(nominal_plant(), (), [recorded({"T3.area": 1.05 * area}, 9)], None), white)
    taper, gain = Placement(effect("area_taper"), "T3"), Placement(effect("sensor_gain"), "h3")
    starts = taper.effect.starts("T3", nominal_plant(), operating_range_of(fitter.data.recording, nominal_plant()))
    fit = fitter.fit(Candidate((taper,), tuple({taper.full_name(n): v for n, v in s.items()} for s in starts)))
    areas = exact_areas_like(fitter, fit, taper, 0.95)
    assert areas["T3.area"] == pytest.approx(1.05 * area, rel=0.01)
    # A sensor's gain of 1.2 is no cross-section.
    fitter = Fitter(checked_data_set(nominal_plant(), (), [recorded({"h3.sensor_gain.factor": 1.2}, 9)], None), white)
    fit = fitter.fit(Candidate((gain,), ({"h3.sensor_gain.factor": 1.1},)))
    assert not exact_areas_like(fitter, fit, gain, 0.95)


def test_explanations_with_the_same_prediction_are_not_separated(rivals: Fitter) -> None:
    fit = rivals.fit(Candidate())
    found = discriminating_input(rivals, fit, fit)
    assert found is not None
    assert found["separation"] == pytest.approx(0.0, abs=1e-9)
    assert found["parted_after"] is None and found["parted_after_samples"] is None


def test_an_ambiguous_answer_of_a_plant_without_inputs_has_no_next_input_and_no_remark_on_inputs() -> None:
    """Lag and delay of a sensor of draining tanks."""
    plant, lag = draining_tanks(), {"a.sensor_lag.time_constant": 4.0}
    planned = constant_inputs(plant, 300.0, sample=2.0)
    clean = clean_readings(build_network(plant, placements_for(lag)), planned, lag)
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    recording = plant.recording(planned.time, planned.inputs, clean + 3e-3 * noise)
    answer = diagnose(plant, recording, settings=Settings(("sensor_lag@a", "sensor_delay@a")))
    assert answer.verdict == "ambiguous" and answer.next_input is None
    assert not any("inputs" in remark for remark in answer.remarks)


def test_an_ambiguous_answer_has_an_input_that_separates_the_rivals() -> None:
    recording = recorded({"Q1.pump_lag.time_constant": 4.0}, 9, samples=400, std=2e-3)
    answer = diagnose(nominal_plant(), recording, settings=Settings(("pump_lag", "pump_delay")))
    assert answer.verdict == "ambiguous"
    assert answer.next_input is not None and len(answer.next_input["between"]) == 2
