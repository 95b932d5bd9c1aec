"""Joint collocation: each recording's part equals its separate simulation, and common parameters are fitted to all."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import ConfigError
from fdi_torch.effects import place
from fdi_torch.gap.answer import adopted
from fdi_torch.gap.candidate import Candidate
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlacedEffect, PlantDescription
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.joint_collocation import JointCollocation

CM = 1e-2


def plant(**changes: object) -> PlantDescription:
    return replace(load_plant("three_tank"), **changes)  # type: ignore[arg-type]


def run(seed: int, samples: int, effects: dict[str, float], offset: float = 0.0) -> Recording:
    """Random steps on the three tanks from 10, 20, 30 cm, every 2 s, with 0.5 mm of noise and an offset of h1."""
    generator = torch.Generator().manual_seed(seed)
    time = 2.0 * torch.arange(samples, dtype=torch.float64)
    steps = torch.rand(samples // 20 + 1, 2, generator=generator, dtype=torch.float64)
    inputs = 80e-6 * steps.repeat_interleave(20, dim=0)[:samples]
    blank = torch.full((samples, 3), torch.nan, dtype=torch.float64)
    recording = plant().recording(time, inputs, blank)
    names = [name.split(".") for name in effects]
    placements = [place(effect, at) for at, effect, _ in names]
    data = data_set_of(plant(), [], recording, 2.0)
    engine = Fitter(data, Noise(torch.ones(3), torch.zeros(3))).engine(Candidate(tuple(placements)), list(effects))
    start = {"T1.start_level": 10 * CM, "T2.start_level": 20 * CM, "T3.start_level": 30 * CM}
    theta = engine.space.vector(start | effects).unsqueeze(0)
    clean = engine.converge(theta).readings[0]
    noise = 5e-4 * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    outputs = clean + noise + torch.tensor([offset, 0.0, 0.0], dtype=torch.float64)
    return replace(recording, outputs=outputs, mask=torch.ones_like(outputs, dtype=torch.bool))


def test_each_recording_is_simulated_as_if_it_were_alone() -> None:
    recordings = [run(1, 60, {}), run(2, 90, {}), run(3, 40, {})]
    believed = plant()
    data = data_set_of(believed, (), recordings, 2.0)
    engine = Fitter(data, Noise(torch.ones(3), torch.zeros(3))).engine(Candidate(), ())
    assert isinstance(engine, JointCollocation)
    starts = {
        f"{t}.start_level@{k}" if k else f"{t}.start_level": 0.1 + 0.05 * k
        for t in ("T1", "T2", "T3")
        for k in range(3)
    }
    theta = engine.space.vector(starts | {"P13.discharge_coefficient": 0.55}).unsqueeze(0)
    joint = engine.converge(theta)
    for k, (recording, rows) in enumerate(zip(recordings, data.rows, strict=True)):
        alone = _alone(believed, recording)
        linearised = alone.converge(_own_theta(alone, k))
        torch.testing.assert_close(joint.readings[:, rows], linearised.readings, rtol=0.0, atol=1e-9)
        columns = [engine.space.index(n if not k or "start" not in n else f"{n}@{k}") for n in alone.space.names]
        torch.testing.assert_close(joint.jacobian[:, rows][..., columns], linearised.jacobian, rtol=1e-6, atol=1e-9)
        foreign = [j for j, n in enumerate(engine.space.names) if "start" in n and j not in columns]
        assert float(joint.jacobian[:, rows][..., foreign].abs().max()) == 0.0


def _alone(believed: PlantDescription, recording: Recording) -> Collocation:
    network = TankNetwork(believed, ())
    names = ("P13.discharge_coefficient", *(f"{t}.start_level" for t in ("T1", "T2", "T3")))
    space = ParameterSpace(network.constants[n] for n in names)
    return Collocation(network, space, lay_out(recording, believed.channels(), 2.0))


def _own_theta(engine: Collocation, k: int) -> torch.Tensor:
    levels = {f"{t}.start_level": 0.1 + 0.05 * k for t in ("T1", "T2", "T3")}
    return engine.space.vector(levels | {"P13.discharge_coefficient": 0.55}).unsqueeze(0)


def test_a_common_cause_is_told_from_offsets_that_differ_from_run_to_run() -> None:
    cause = {"Q2.pump_gain.factor": 1.1}
    recordings = [run(11, 150, cause, offset=4e-3), run(12, 200, cause, offset=-6e-3)]
    tolerances = plant().tolerances | {"h1.offset": 5e-3}
    known = plant(tolerances=tolerances, varying=("h1.offset",))
    settings = Settings(("pump_gain", "sensor_bias@h1", "plugging@P13"))
    answer = diagnose(known, recordings, settings=settings)
    assert [(c.effect, c.location) for c in answer.causes] == [("pump_gain", "Q2")]
    factor = answer.causes[0].parameters["factor"]
    assert abs(factor.value - 1.1) < 4.0 * factor.std < 0.04
    refound = adopted(known, answer, constants=True)
    assert refound.tolerances["Q2.pump_gain.factor"] >= factor.std
    again = diagnose(refound, recordings, settings=settings)
    assert again.verdict == "no_gap"
    assert abs(again.constants["Q2.pump_gain.factor"]["augmented"] - 1.1) < 0.02


def test_what_varies_and_tolerances_of_effects_are_read_and_written() -> None:
    data = plant_mapping(plant(effects=(PlacedEffect("pump_lag", "Q1", {"time_constant": 8.0}),)))
    data |= {"tolerances": {"h?.offset": "5 mm", "*.pump_lag.time_constant": "2 s"}, "varying": ["h?.offset"]}
    read = build_plant(data, "rig.yaml")
    assert read.varying == ("h1.offset", "h2.offset", "h3.offset")
    assert read.tolerances["Q1.pump_lag.time_constant"] == 2.0
    assert build_plant(plant_mapping(read), "again.yaml") == read
    with pytest.raises(ConfigError, match="varying: expected a constant with a tolerance"):
        build_plant(data | {"varying": ["Q1.gain"]}, "rig.yaml")
