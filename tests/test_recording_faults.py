"""Recording faults on plants other than the three tanks: each swapped pair, and the cost of many silent sensors."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

from fdi_torch.blind.case_drafts import plans
from fdi_torch.blind.cases import make
from fdi_torch.blind.inputs import FACTORS, command_unit
from fdi_torch.blind.plants import RIGS
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.preprocess.acquisition import examined
from fdi_torch.plant.description import Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.recording import Recording
from tests.rigs import blank_recording, random_steps


def sound(rig: str, seed: int) -> tuple[PlantDescription, Recording]:
    """A rig of the blind benchmark without a fault; its constants lie within their tolerances."""
    case = make(plans(1, seed, ("null",)), RIGS[rig](), seed)[0]
    plant = case.rig.plant
    pumps = {p.channel: p for p in reversed(plant.pumps)}
    factors = np.array([FACTORS[command_unit(pumps[channel])] for channel in plant.channels()])
    time = torch.arange(len(case.readings[0]), dtype=torch.float64)
    blank = blank_recording(plant, torch.from_numpy(case.commands[0] * factors), time)
    units = tuple(plant.channel_units().values())
    return plant, replace(blank, outputs=torch.from_numpy(case.readings[0]), mask=~blank.mask, input_units=units)


@pytest.mark.parametrize(("rig", "seed"), [("quadruple_tank", 101), ("three_tank", 102)])
def test_each_swapped_pair_is_refused(rig: str, seed: int) -> None:
    """The constants that fit the wrong recording differ from the true ones by several standard deviations."""
    plant, run = sound(rig, seed)
    for i, j in combinations(range(len(plant.sensors)), 2):
        outputs = run.outputs.clone()
        outputs[:, [i, j]] = outputs[:, [j, i]]
        found = examined(plant, replace(run, outputs=outputs))
        assert found.fault, (i, j)
        assert f"{plant.sensors[i].column} and {plant.sensors[j].column} seem to be swapped" in found.fault.text


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


def test_the_cost_of_silent_sensors_grows_in_proportion_to_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    two, four, eight = (fits_with_all_sensors_stuck(n, monkeypatch) for n in (2, 4, 8))
    assert eight - four <= 2 * (four - two) + 10, (two, four, eight)
