"""Recording faults on plants other than the three tanks: a swapped pair, and the cost of many silent sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fdi_torch.blind.case_drafts import plans
from fdi_torch.blind.cases import make
from fdi_torch.blind.inputs import FACTORS, command_unit
from fdi_torch.blind.plants import RIGS
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import effect
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.preprocess.acquisition import examined, thorough_findings
from fdi_torch.gap.preprocess.blockwise_likelihood import blocked_recording, blockwise_fit, noise_of
from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, Correction
from fdi_torch.gap.preprocess.recording_fault_decision import FaultSearch, _log_weight
from fdi_torch.gap.preprocess.recording_faults import _units
from fdi_torch.plant.description import Pipe, PlacedEffect, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Placement
from fdi_torch.recording import Recording
from tests.rigs import blank_recording, random_steps
from tests.test_gap_convergence import recorded


def test_a_swap_is_refused_although_the_constants_were_fitted_to_it() -> None:
    """They differ from the true ones by several standard deviations, and with them the right swap looks like a loss."""
    drawn = make(plans(2, 101, ("null",))[1:], RIGS["quadruple_tank"](), 101)[0]
    plant = drawn.rig.plant
    pumps = {p.channel: p for p in reversed(plant.pumps)}
    factors = np.array([FACTORS[command_unit(pumps[channel])] for channel in plant.channels()])
    time = torch.arange(len(drawn.readings[0]), dtype=torch.float64)
    blank = blank_recording(plant, torch.from_numpy(drawn.commands[0] * factors), time)
    readings = (torch.from_numpy(drawn.readings[0]) / 1e-5).round() * 1e-5
    units = tuple(plant.channel_units().values())
    swapped = replace(
        blank, outputs=readings[:, [0, 2, 1, 3]], mask=torch.ones_like(readings, dtype=torch.bool), input_units=units
    )
    found = examined(plant, swapped)
    assert found.fault and "h2 and h3 seem to be swapped" in found.fault.text


def bench() -> PlantDescription:
    """Two equal tanks: a pump into the first, whose lag the plant file knows, and a drain from the second."""
    return PlantDescription(
        "bench",
        tuple(Tank(name, 200e-4, 0.6, 0.2) for name in "AB"),
        (Pipe("link", "A", "B", 0.6e-4, 0.6), Pipe("drain", "B", "outside", 0.5e-4, 0.6)),
        (Pump("Q", "A", 100e-6),),
        (Sensor("hA", "A"), Sensor("hB", "B")),
        effects=(PlacedEffect("pump_lag", "Q", {"time_constant": 8.0}),),
        tolerances={"link.discharge_coefficient": 0.03, "drain.discharge_coefficient": 0.03},
    )


def chain(count: int) -> PlantDescription:
    """Tanks in series, a pump into the first, a sensor in each."""
    names = [f"T{i}" for i in range(count)]
    return PlantDescription(
        "chain",
        tuple(Tank(n, 160e-4, 1.0, 0.4) for n in names),
        tuple(Pipe(f"P{a}", a, b, 0.6e-4, 0.6) for a, b in zip(names, [*names[1:], "outside"], strict=True)),
        (Pump("Q", "T0", 90e-6),),
        tuple(Sensor(f"h{i}", n) for i, n in enumerate(names)),
        tolerances={f"P{n}.discharge_coefficient": 0.03 for n in names},
    )


def filling_with_valves_nearly_closed() -> tuple[PlantDescription, Recording]:
    """Two minutes, shorter than a tank needs to empty: the pumps deliver less than is asked for, M stays empty."""
    plant, time = load_plant("dts200"), torch.arange(1200, dtype=torch.float64) / 10.0
    openings = {"vLM": 0.0025, "vMR": 0.0032, "vLD": 0.002, "vMD": 0.0022, "vRD": 0.002}
    pumped = torch.where(time < 60.0, 30e-6, 90e-6)
    inputs = [torch.full_like(time, openings[c]) if c in openings else pumped for c in plant.channels()]
    empty = replace(plant, tanks=tuple(replace(tank, start_level=0.0) for tank in plant.tanks))
    truth = {"qR.pump_dead_zone.dead_zone": 3e-6, "qL.pump_gain.factor": 0.8}
    return plant, recorded(empty, blank_recording(plant, torch.stack(inputs, dim=1), time), truth, 1, noise=1e-5)


def test_no_unit_is_suspected_whose_values_would_be_impossible() -> None:
    """A level of metres in a tank of 62 cm, a valve that is opened to 200 %, ten times what a pump can deliver."""
    plant, run = filling_with_valves_nearly_closed()
    noise = noise_of(plant, run)
    fits = CorrectedFits(plant, run, blockwise_fit(blocked_recording(plant, run, noise)), -8.0, noise)
    texts = [correction.fault.text for each in _units(fits) for correction in each]
    assert not [text for text in texts if text.startswith(("h1_L", "h2_R", "q")) and "too small" in text]
    assert [text.partition("unit")[0] for text in texts if "100 times too small" in text] == [
        f"{channel}: its " for channel in ("h3_M", "vLM", "vMR", "vLD", "vMD", "vRD")
    ]
    assert not [text for text in texts if text.startswith("v") and "1000 times too small" in text]
    assert examined(plant, run, thorough=True).fault is None


def test_the_initial_level_of_a_short_recording_hides_no_error() -> None:
    """Its one mean over the recording would be 0.06 mm at R, although the residuals are millimetres."""
    plant, run = filling_with_valves_nearly_closed()
    fit = blockwise_fit(blocked_recording(plant, run, noise_of(plant, run)))
    residual = fit.blocked.data.readings - fit.readings
    assert fit.blocked.errors == 1.0
    assert float(residual[:, 2].square().mean()) > 1e-6  # m^2
    assert bool((fit.variance > 0.5 * residual.square().mean(dim=0))[[0, 2]].all())


def test_effects_of_the_plant_file_are_no_argument_against_an_effect_of_the_plant() -> None:
    """All hypotheses share the parameters of the effects that the plant file has."""
    plant, truth = chain(2), {"T0.leak.size": 0.3}
    run = recorded(plant, random_steps(plant, 1200.0, seed=2), truth, 2)
    lag, drift = PlacedEffect("pump_lag", "Q", {"time_constant": 1.0}), {"Q.pump_lag.time_constant": 0.5}
    weights = []
    for each in (plant, replace(plant, effects=(lag,), tolerances=plant.tolerances | drift)):
        as_is = blockwise_fit(blocked_recording(each, run, noise_of(each, run)))
        leak = blockwise_fit(
            as_is.blocked, Candidate((Placement(effect("leak"), "T0"),), ({"T0.leak.size": 0.1},)), as_is
        )
        weights.append(_log_weight(leak, as_is, 20) - leak.log_likelihood)
    assert weights[1] == pytest.approx(weights[0], abs=1e-9)


@pytest.mark.parametrize(("seed", "size"), [(6, 0.3), (4, 0.6)])
def test_a_thorough_examination_finds_a_swap_beside_a_leak(seed: int, size: float) -> None:
    """Ten times the readings would be above the rim; the swap alone gains less than other faults, or nothing."""
    plant = bench()
    sound = recorded(plant, random_steps(plant, 600.0, seed=seed), {"A.leak.size": size}, seed)
    swapped = replace(sound, outputs=sound.outputs[:, [1, 0]])
    assert examined(plant, sound, thorough=True).fault is None
    assert thorough_findings(plant, [sound, swapped]) == (swap_of("hA", "hB"),)


def test_effects_that_explain_a_swap_as_far_as_they_can_do_not_hide_it() -> None:
    """They compete with the swap by the same likelihood; those of the sound recording win."""
    plant, leak = bench(), Placement(effect("leak"), "A")
    sound = recorded(plant, random_steps(plant, 600.0, seed=6), {"A.leak.size": 0.3}, 6)
    swapped = replace(sound, outputs=sound.outputs[:, [1, 0]])
    best = Candidate(
        (leak, Placement(effect("sensor_gain"), "hA")), ({"A.leak.size": 0.3, "hA.sensor_gain.factor": 0.8},)
    )
    assert examined(plant, swapped).thorough_finding(best) == swap_of("hA", "hB")
    assert examined(plant, sound).thorough_finding(Candidate((leak,), ({"A.leak.size": 0.3},))) == ""


def test_a_thorough_examination_repeats_no_fit_of_the_plain_one(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, fits = bench(), 0
    sound = recorded(plant, random_steps(plant, 600.0, seed=6), {"A.leak.size": 0.3}, 6)
    original = Fitter.fit

    def counted(self: Fitter, *arguments: object, **options: object) -> object:
        nonlocal fits
        fits += 1
        return original(self, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Fitter, "fit", counted)
    examined(plant, sound, thorough=True)
    at_once, fits = fits, 0
    checked = examined(plant, sound)
    assert fits
    checked.thorough_finding()
    assert fits == at_once


EFFECTS = ("leak", "plugging", "pump_gain", "sensor_gain", "sensor_bias")


@pytest.mark.slow
def test_the_gap_diagnosis_says_a_swap_that_leaves_it_without_a_sure_cause() -> None:
    plant = bench()
    sound = recorded(plant, random_steps(plant, 600.0, seed=6), {"A.leak.size": 0.3}, 6)
    swapped = replace(sound, outputs=sound.outputs[:, [1, 0]])
    answer = diagnose(plant, swapped, settings=Settings(EFFECTS))
    assert answer.verdict in ("ambiguous", "unknown")
    assert swap_of("hA", "hB") in answer.remarks


def swap_of(a: str, b: str) -> str:
    fix = f"columns: {{{a}: {{column: {b}}}, {b}: {{column: {a}}}}}"
    return f"{a} and {b} seem to be swapped; assign the columns, as in {fix}"


@pytest.mark.parametrize(("pipe", "duration", "seed"), [("PT0", 600.0, 3), ("PT1", 1200.0, 5)])
def test_a_thorough_examination_finds_a_swap_beside_a_plugged_pipe(pipe: str, duration: float, seed: int) -> None:
    """Neither the swap nor an effect alone explains the recording; both together do."""
    plant = chain(2)
    sound = recorded(plant, random_steps(plant, duration, seed=seed), {f"{pipe}.plugging.size": 0.3}, seed)
    swapped = replace(sound, outputs=sound.outputs[:, [1, 0]])
    assert examined(plant, sound, thorough=True).fault is None
    assert examined(plant, swapped).fault is None
    found = examined(plant, swapped, thorough=True).fault
    assert found and "h0 and h1 seem to be swapped" in found.text


def fits_with_all_sensors_stuck(count: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """Fits that the examination of a chain takes where no sensor moves."""
    plant, fits = chain(count), 0
    run = random_steps(plant, 600.0)
    levels = torch.linspace(0.35, 0.65, count, dtype=torch.float64)
    run = replace(run, outputs=levels.expand(len(run), count), mask=torch.ones(len(run), count, dtype=torch.bool))
    original = Fitter.fit

    def counted(self: Fitter, *arguments: object, **options: object) -> object:
        nonlocal fits
        fits += 1
        return original(self, *arguments, **options)  # type: ignore[arg-type]

    with monkeypatch.context() as patched:
        patched.setattr(Fitter, "fit", counted)
        found = examined(plant, run)
    assert found.fault is None
    assert {s.sensor.name for s in found.stuck} == {s.name for s in plant.sensors}
    return fits


def test_no_fault_is_fitted_where_one_effect_explains_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lag of a pump makes a shift of the clock a gain, to first order."""
    plant, truth = chain(3), {"Q.pump_lag.time_constant": 60.0}
    recording = recorded(plant, random_steps(plant, 1200.0), truth, seed=1)
    suspected = 0
    original = CorrectedFits.first_order_gain

    def counted(self: CorrectedFits, correction: Correction) -> float:
        nonlocal suspected
        gain = original(self, correction)
        suspected += gain > 0.0
        return gain

    def refused(self: CorrectedFits, *arguments: object) -> None:
        raise AssertionError("expected no fit of a fault")

    monkeypatch.setattr(CorrectedFits, "first_order_gain", counted)
    monkeypatch.setattr(CorrectedFits, "fit", refused)
    assert FaultSearch(plant, recording).fault() is None
    assert suspected


@pytest.mark.slow
def test_the_cost_of_silent_sensors_grows_in_proportion_to_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    two, four, six = (fits_with_all_sensors_stuck(n, monkeypatch) for n in (2, 4, 6))
    assert six - four <= four - two + 10, (two, four, six)


def test_all_sensors_may_be_stuck_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """One enumeration finds them: a second one per sensor would double the number of fits (102 and 51)."""
    assert fits_with_all_sensors_stuck(2, monkeypatch) < 75
