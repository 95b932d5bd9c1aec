"""The FMU of a plant: FMPy's simulation of it equals ours, and its description is valid."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
import torch
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.validation import validate_fmu
from torch import Tensor

from fdi_torch import cli, export_fmu
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import all_placements, build_network, place, placements_for
from fdi_torch.plant.description import Pipe, PlacedEffect, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.operating_range import operating_range_of
from fdi_torch.recording import Recording
from fdi_torch.simulate.simulated_recording import clean_readings

CLOSE = 1e-4  # m, as promised in docs/how-to/fmu.md

THREE_TANKS = load_plant("three_tank")
VALVE = PlantDescription(
    "1 valve & pump",
    (Tank("A", area=0.02, height=0.3, overflow_to="B"), Tank("B", area=0.03, height=0.4)),
    (
        Pipe("AB", "A", "B", area=5e-5, discharge_coefficient=0.6, valve="v"),
        Pipe("OUT", "B", "outside", area=4e-5, discharge_coefficient=0.6),
    ),
    (Pump("Q", "A", max_flow=2e-4, gain=1e-4 / 5.0, command="u"),),
    (Sensor("LA", "A", gain=100.0 * 98.1, offset=12.0, low=50.0, high=2000.0), Sensor("LB", "B")),
)


def with_effects(plant: PlantDescription, **effects: dict[str, float]) -> PlantDescription:
    """The plant with known effects, such as T1__leak={"size": 0.3}."""
    places = (name.split("__") for name in effects)
    placed = [PlacedEffect(e, p, values) for (p, e), values in zip(places, effects.values(), strict=True)]
    return replace(plant, effects=tuple(placed))


def planned(plant: PlantDescription, duration: float, step: float) -> Recording:
    """A recording without readings, of inputs that switch every 20 steps between none and all they can do."""
    time = torch.arange(0.0, duration + step / 2, step, dtype=torch.float64)
    generator = torch.Generator().manual_seed(5)
    most = {p.channel: p.max_flow / p.gain for p in plant.pumps}
    shares = torch.rand(len(time) // 20 + 1, len(plant.channels()), generator=generator, dtype=torch.float64)
    shares[1] = 0.0
    inputs = shares.repeat_interleave(20, dim=0)[: len(time)] * torch.tensor(
        [most.get(c, 1.0) for c in plant.channels()]
    )
    return plant.recording(time, inputs, torch.full((len(time), len(plant.sensors)), torch.nan, dtype=torch.float64))


def by_fmpy(fmu: Path, recording: Recording, start_values: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Outputs at the recording's samples, with its inputs held in between."""
    time = recording.time.numpy()
    # FMPy takes inputs at discontinuities from the right: the instant stands twice, as before and after.
    step = float(time[1] - time[0])
    fields = [("time", float), *((name, float) for name in recording.input_names)]
    rows = [(t, *values) for t, values in zip(time, recording.inputs.tolist(), strict=True)]
    held = [(b[0], *a[1:]) for a, b in pairwise(rows)]
    signal = np.array([row for pair in zip(rows, held, strict=False) for row in pair] + rows[-1:], dtype=fields)
    found = fmpy.simulate_fmu(
        str(fmu),
        start_values=dict(start_values),
        input=signal,
        stop_time=time[-1],
        output_interval=step,
        step_size=step,
    )
    assert np.allclose(found["time"], time)
    return {name: found[name] for name in found.dtype.names}


@pytest.fixture(scope="module")
def three_tanks_fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The three tanks with all effects of `CASES` that are parameters."""
    fmu = tmp_path_factory.mktemp("three_tanks") / "plant.fmu"
    export_fmu(THREE_TANKS, fmu, effects=["P13.plugging", "T1.leak", "T2.leak"])
    assert validate_fmu(str(fmu)) == []
    return fmu


def error(plant: PlantDescription, fmu: Path, recording: Recording, values: Mapping[str, float]) -> float:
    """Largest difference of the readings, as a level in m."""
    ours: Tensor = clean_readings(build_network(plant, placements_for(values)), recording, values)
    theirs = by_fmpy(fmu, recording, values)
    gains = torch.tensor([s.gain for s in plant.sensors], dtype=torch.float64)
    columns = torch.tensor(np.stack([theirs[s.column] for s in plant.sensors], axis=-1))
    return float(((columns - ours) / gains).abs().max())


CASES: dict[str, tuple[PlantDescription, dict[str, float]]] = {
    "nominal": (THREE_TANKS, {}),
    "faults set as parameters": (THREE_TANKS, {"T1.leak.size": 0.3, "P13.plugging.size": 0.4, "T3.start_level": 0.1}),
    "effects with memory": (
        with_effects(
            THREE_TANKS,
            Q1__pump_lag={"time_constant": 8.0},
            h1__sensor_lag={"time_constant": 15.0},
            h2__sensor_hysteresis={"play": 0.01},
        ),
        {},
    ),
    "effect anchored in time": (THREE_TANKS, {"T2.leak.size": 0.5, "T2.leak.onset": 333.0}),
    "overflow": (THREE_TANKS, {"T1.height": 0.55, "T1.start_level": 0.5, "OUT2.discharge_coefficient": 0.1}),
    "empty tanks": (THREE_TANKS, {"T1.start_level": 0.02, "T2.start_level": 0.0, "T2.leak.size": 2.0}),
    "valve and a sensor that is clipped": (VALVE, {"A.start_level": 0.25}),
    "two pumps on one command": (load_plant("quadruple_tank"), {}),
}


@pytest.mark.parametrize("case", CASES)
def test_fmpy_simulates_what_we_simulate(case: str, tmp_path: Path, three_tanks_fmu: Path) -> None:
    plant, values = CASES[case]
    fmu = three_tanks_fmu if plant is THREE_TANKS else tmp_path / "plant.fmu"
    if plant is not THREE_TANKS:
        export_fmu(plant, fmu)
        assert validate_fmu(str(fmu)) == []
    assert error(plant, fmu, planned(plant, 1000.0, 5.0), values) < CLOSE


def test_every_effect_without_a_dead_time_is_that_of_the_library(tmp_path: Path) -> None:
    """All at all their places in one FMU, each set to its largest start value in turn."""
    placements = [p for p in all_placements(VALVE) if not p.prefix.endswith("_delay")]
    network, recording = build_network(VALVE, placements), planned(VALVE, 200.0, 5.0)
    export_fmu(VALVE, tmp_path / "plant.fmu", effects=[p.prefix for p in placements])
    reach, nominal = operating_range_of(recording, VALVE), {p.name: p.nominal for p in network.constants}
    without = clean_readings(network, recording, nominal)
    shown, errors = 0, {}
    for placement in placements:
        start = placement.effect.starts(placement.location, VALVE, reach)[-1]
        values = nominal | {f"{placement.prefix}.{name}": value for name, value in start.items()}
        ours = clean_readings(network, recording, values)
        theirs = by_fmpy(tmp_path / "plant.fmu", recording, values)
        columns = torch.tensor(np.stack([theirs[s.column] for s in VALVE.sensors], axis=-1))
        gains = torch.tensor([s.gain for s in VALVE.sensors], dtype=torch.float64)
        errors[placement.prefix] = float(((columns - ours) / gains).abs().max())
        shown += bool(((ours - without) / gains).abs().max() > CLOSE)
    assert shown > len(placements) / 2  # the others pass a noise-free reading, or these inputs do not reach them
    assert {prefix: e for prefix, e in errors.items() if not e < CLOSE} == {}


def test_the_sensor_is_clipped_and_the_tank_overflows_in_the_case_above(tmp_path: Path) -> None:
    export_fmu(VALVE, tmp_path / "plant.fmu")
    found = by_fmpy(tmp_path / "plant.fmu", planned(VALVE, 1000.0, 5.0), {"A.start_level": 0.25})
    assert found["LA"].max() == 2000.0
    assert found["A.level"].max() > 0.3


def test_a_parameter_may_change_between_steps(tmp_path: Path) -> None:
    """A leak that opens during a run is the leak of the library with that onset."""
    fmu, recording = tmp_path / "plant.fmu", planned(THREE_TANKS, 600.0, 5.0)
    variables = export_fmu(THREE_TANKS, fmu, effects=["T1.leak"]).columns
    slave = started(fmu)
    reference = {name: k for k, name in enumerate(variables["name"])}
    readings = []
    for k, time in enumerate(recording.time.tolist()):
        if k:
            slave.setReal([0, 1], recording.inputs[k - 1].tolist())
            slave.doStep(time - 5.0, 5.0)
        readings.append(slave.getReal([reference[name] for name in ("h1", "h2", "h3")]))
        if time == 300.0:
            slave.setReal([reference["T1.leak.size"]], [0.4])
    close(slave)
    truth = {"T1.leak.size": 0.4, "T1.leak.onset": 300.0}
    ours = clean_readings(build_network(THREE_TANKS, [place("leak", "T1")]), recording, truth)
    assert float((torch.tensor(readings) - ours).abs().max()) < CLOSE


@pytest.fixture(scope="module")
def three_tanks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("fmu") / "plant.fmu"
    export_fmu(THREE_TANKS, file)
    return file


def test_a_saved_state_is_restored(three_tanks: Path) -> None:
    slave = started(three_tanks)
    slave.setReal([0], [1e-4])
    slave.doStep(0.0, 10.0)
    state = slave.getFMUstate()
    saved = slave.serializeFMUstate(state)
    slave.doStep(10.0, 10.0)
    after = slave.getReal([2, 3, 4])
    slave.reset()
    assert slave.getReal([2, 3, 4]) != after
    slave.setFMUstate(slave.deSerializeFMUstate(saved))
    slave.doStep(10.0, 10.0)
    assert slave.getReal([2, 3, 4]) == after
    close(slave)


@pytest.mark.parametrize("misuse", ["output", "reference", "not a number", "step"])
def test_misuse_is_an_error_status(misuse: str, three_tanks: Path) -> None:
    slave = started(three_tanks)
    with pytest.raises(FMICallException):
        if misuse == "output":
            slave.setReal([2], [0.1])
        elif misuse == "reference":
            slave.getReal([9999])
        elif misuse == "not a number":
            slave.setReal([0], [float("nan")])
        else:
            slave.doStep(0.0, 0.0)
    close(slave)


def test_a_dead_time_is_refused(tmp_path: Path) -> None:
    delayed = with_effects(THREE_TANKS, Q1__pump_delay={"delay": 3.0})
    with pytest.raises(ValueError, match="without a dead time, got a delay at Q1"):
        export_fmu(delayed, tmp_path / "plant.fmu")


def test_a_name_for_two_variables_is_refused(tmp_path: Path) -> None:
    doubled = replace(VALVE, sensors=(Sensor("LA", "A", channel="u"),))
    with pytest.raises(ValueError, match="got 'u' twice"):
        export_fmu(doubled, tmp_path / "plant.fmu")


def test_the_command_tells_the_variables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "rig.fmu"
    assert (
        cli.main(["export", "--plant", "three_tank", "--fmu", str(file), "--effect", "T1.leak", "--json"]) == cli.DONE
    )
    shown = json.loads(capsys.readouterr().out)
    leak = {"name": "T1.leak.size", "causality": "parameter", "variability": "tunable", "unit": "1", "start": 0.0}
    assert leak in shown["variables"]
    assert cli.main(["export", "--plant", "three_tank", "--fmu", str(file), "--effect", "T1.leak"]) == cli.DONE
    told = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert told[-len(shown["variables"]) - 1] == ["name", "causality", "variability", "unit", "start"]
    assert ["T1.leak.size", "parameter", "tunable", "1", "0"] in told
    assert [row[0] for row in told[-len(shown["variables"]) :]] == [each["name"] for each in shown["variables"]]
    assert cli.main(["export", "--plant", "three_tank", "--fmu", str(file), "--effect", "leak"]) == cli.MISUSE
    assert "such as T1.leak" in capsys.readouterr().err


def started(fmu: Path) -> Any:
    description = fmpy.read_model_description(str(fmu))
    slave = FMU2Slave(
        guid=description.guid,
        unzipDirectory=fmpy.extract(str(fmu)),
        modelIdentifier=description.coSimulation.modelIdentifier,
    )
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    return slave


def close(slave: Any) -> None:
    slave.terminate()
    slave.freeInstance()
