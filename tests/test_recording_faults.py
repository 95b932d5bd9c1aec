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
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.preprocess.acquisition import examined
from fdi_torch.gap.preprocess.corrected_fit import CorrectedFits, Correction
from fdi_torch.gap.preprocess.recording_fault_decision import recording_fault
from fdi_torch.plant.description import Pipe, PlantDescription, Pump, Sensor, Tank
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
    assert recording_fault(plant, recording) is None
    assert suspected


@pytest.mark.slow
def test_the_cost_of_silent_sensors_grows_in_proportion_to_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    two, four, six = (fits_with_all_sensors_stuck(n, monkeypatch) for n in (2, 4, 6))
    assert six - four <= four - two + 10, (two, four, six)


def test_all_sensors_may_be_stuck_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """One enumeration finds them: a second one per sensor would double the number of fits (102 and 51)."""
    assert fits_with_all_sensors_stuck(2, monkeypatch) < 75
