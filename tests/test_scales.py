"""Invariance to scales: a rig scaled in length and time gives scaled results."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rigs import blank_recording, three_tank

from fdi_torch.config import load_plant, load_run
from fdi_torch.config.monitor_file import MonitorConfig
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.resolved_config import resolve
from fdi_torch.effects import EFFECTS, all_placements, build_network, placements_for
from fdi_torch.estimate.fitting import set_up
from fdi_torch.estimate.hybrid import estimate_parameters
from fdi_torch.jobs.run_setup import fitting_of, recordings_of, requested_space
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monitor_setup import prepare_monitor
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import usual_step
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.equilibrium import equilibrium
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.simulated_recording import clean_readings, with_noise
from fdi_torch.simulate.step_control import StepControl
from fdi_torch.simulate.traced_engine import TracedEngine
from tests.test_monitor import NAMES, SPACE, followed, recorded, step_to

SCALES = [(0.01, 1.0), (100.0, 1.0), (1.0, 0.05), (1.0, 60.0), (0.1, 0.05), (20.0, 60.0)]
FAULTS = {"T1.leak.size": 0.2, "P13.plugging.size": 0.3}
scaled_rigs = pytest.mark.parametrize(("metres", "seconds"), SCALES)


def scaled(plant: PlantDescription, metres: float, seconds: float) -> PlantDescription:
    """The same rig of other lengths, on a planet and with pumps that make it run at another pace."""
    tanks = tuple(
        replace(t, area=t.area * metres**2, height=t.height * metres, start_level=(t.start_level or 0.3) * metres)
        for t in plant.tanks
    )
    pipes = tuple(replace(p, area=p.area * metres**2, elevation=p.elevation * metres) for p in plant.pipes)
    pumps = tuple(replace(p, max_flow=p.max_flow * metres**3 / seconds) for p in plant.pumps)
    return replace(plant, tanks=tanks, pipes=pipes, pumps=pumps, gravity=plant.gravity * metres / seconds**2)


def experiment(metres: float, seconds: float) -> tuple[PlantDescription, Recording]:
    plant = scaled(three_tank(), metres, seconds)
    time = torch.arange(201, dtype=torch.float64) * 2.0
    flow = 35e-6 + 25e-6 * ((time // 100.0) % 2 == 0).to(time)
    inputs = torch.stack([flow, 100e-6 - flow], dim=1)
    return plant, blank_recording(plant, inputs * metres**3 / seconds, time * seconds)


def test_shipped_rigs_are_the_measure() -> None:
    for name in ("three_tank", "dts200", "cascaded_tanks", "quadruple_tank", "three_tank_leak"):
        plant = load_plant(name)
        assert (time_scale(plant), length_scale(plant)) == (1.0, 1.0), name


@scaled_rigs
def test_ranges_of_effects_scale_with_the_rig(metres: float, seconds: float) -> None:
    usual, other = three_tank(), scaled(three_tank(), metres, seconds)
    per_unit = {"1": 1.0, "m": metres, "m^2": metres**2, "s": seconds, "1/s": 1 / seconds, "m/s": metres / seconds}
    per_unit |= {"m^3": metres**3, "m^3/s": metres**3 / seconds, "1/m": 1 / metres, "s^2/m^3": seconds**2 / metres**3}
    allowed = 1.01 * math.sqrt(10.0) ** 2  # both scales are right to half a power of ten
    for placement in all_placements(usual):
        here = placement.effect.parameters(placement.location, usual)
        there = placement.effect.parameters(placement.location, other)
        for a, b in zip(here, there, strict=True):
            for end in ("nominal", "low", "high"):
                expected, got = getattr(a, end) * per_unit[a.unit], getattr(b, end)
                where = f"{placement.prefix}.{a.name}.{end}: {got:g} instead of {expected:g}"
                same = got == expected or abs(math.log(got / expected)) < math.log(allowed)
                assert same, where
    assert {p.effect.name for p in all_placements(usual)} <= {e.name for e in EFFECTS}


@scaled_rigs
def test_levels_scale_with_the_rig(metres: float, seconds: float) -> None:
    readings = []
    for m, s in ((1.0, 1.0), (metres, seconds)):
        plant, blank = experiment(m, s)
        network = build_network(plant, placements_for(FAULTS))
        readings.append(clean_readings(network, blank, FAULTS) / m)
        rest = equilibrium(build_network(plant), blank.inputs[0])
        readings.append(rest / m)
    usual, usual_rest, other, other_rest = readings
    torch.testing.assert_close(other, usual, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(other_rest, usual_rest, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize(("metres", "seconds"), [(0.01, 1.0), (10.0, 100.0), (1.0, 0.01)])
def test_steps_of_a_lane_s_own_scale_with_the_rig(metres: float, seconds: float) -> None:
    """Chosen by powers of ten, which the scales of a plant are, so that nothing but rounding is left."""
    found = []
    for m, s in ((1.0, 1.0), (metres, seconds)):
        plant, blank = experiment(m, s)
        own = StepControl.for_fixed_step(0.5 * s, plant)
        assert own.resolution == pytest.approx(0.5 * s)
        network = build_network(plant, placements_for(FAULTS))
        space = ParameterSpace(network.constants[name] for name in FAULTS)
        engine = TracedEngine(network, space, lay_out(blank.stretch(0, 12), plant.channels(), s, own))
        found.append(engine.readings(space.vector(FAULTS)[None]) / m)
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("metres", "seconds"), [(0.01, 60.0), (100.0, 0.05)])
def test_faults_and_their_errors_do_not_depend_on_the_rig_s_size(metres: float, seconds: float) -> None:
    found = []
    for m, s in ((1.0, 1.0), (metres, seconds)):
        plant, blank = experiment(m, s)
        network = build_network(plant, placements_for(FAULTS))
        clean = clean_readings(network, blank, FAULTS)
        std = torch.full((3,), 1e-3 * m, dtype=torch.float64)
        recording = with_noise(blank, clean, std, torch.Generator().manual_seed(3), network)
        found.append(estimate_parameters(set_up(plant, [recording], FAULTS)))
    usual, other = (f.estimate for f in found)
    apart = (other.value - usual.value)[:2].abs() / usual.std[:2]
    assert float(apart.max()) < 0.05, (usual.value, other.value)
    torch.testing.assert_close(other.std[:2], usual.std[:2], rtol=0.02, atol=0.0)
    assert found[0].diagnosis.kind == found[1].diagnosis.kind == "multiple faults"


def test_times_of_a_monitor_that_nobody_chose_follow_the_plant() -> None:
    slow = plant_mapping(scaled(three_tank(), 1.0, 60.0))
    given = {"recording": {"file": "any.csv"}, "fault_free": ["0 s", "1 h"], "window": {"confirm": "90 s"}}
    config, _, _ = resolve(MonitorConfig, given | {"plant": slow}, Path(), "slow.yaml")
    usual, _, _ = resolve(MonitorConfig, given, Path(), "usual.yaml")
    assert (usual.window.lookback, usual.window.confirm, usual.false_alarms_every, usual.step) == (300, 90, 20000, 1)
    assert (config.window.lookback, config.window.confirm, config.false_alarms_every) == (30000, 90, 2e6)
    assert config.step == usual_step(scaled(three_tank(), 1.0, 60.0)) == 100


def test_the_monitor_says_the_same_of_a_rig_of_another_size() -> None:
    """A start level that is off by metres, beside readings that are off by millimetres, would alarm on small rigs."""
    runs = (recorded(lambda t: SPACE.nominal(), 400, seed=99), recorded(step_to("T3.leak.size", 0.05, 100.0), 200))
    said = []
    for m, s in ((1.0, 1.0), (0.1, 100.0)):
        plant = scaled(load_plant("three_tank"), m, s)
        quiet, faulty = (
            Samples(run.time * s, run.inputs * m**3 / s, run.readings * m, run.hold) for run in runs
        )  # fmt: skip
        names = ("Q1", "Q2"), ("h1", "h2", "h3"), ("m^3/s",) * 2, ("m",) * 3
        settings = MonitorSettings(120.0 * s, 40.0 * s, longest=400.0 * s, incipient=False, together=1)
        learnt = Recording(quiet.time, quiet.inputs, quiet.readings, *names)
        watch = prepare_monitor(plant, learnt, NAMES, time_between_false_alarms=20000.0 * s, settings=settings).monitor
        _, events = followed(watch, faulty)
        assert [e.kind for e in events][:2] == ["alarm", "isolated"]
        said.append([(e.kind, e.time / s, e.faults, e.sizes, (e.onset or 0.0) / s) for e in events])
    for usual, other in zip(*said, strict=True):
        assert (other[0], other[2]) == (usual[0], usual[2])
        assert [other[1], *other[3], other[4]] == pytest.approx([usual[1], *usual[3], usual[4]], rel=1e-5)


def test_an_onset_is_sought_within_the_recording() -> None:
    run = load_run(overrides=["estimate.parameters=[T1.leak, T1.leak.onset]", "simulate.duration=400 s"])
    fitting = fitting_of(run, requested_space(run), recordings_of(run))
    assert (fitting.space["T1.leak.onset"].low, fitting.space["T1.leak.onset"].high) == (0.0, 400.0)
