"""Invariance to scales: a rig of other lengths and at another pace gives the same results in its own units.

The factors are not powers of two or ten, so that nothing but rounding may differ.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from own_steps import OwnStepsEngine
from rigs import blank_recording, factor, rescaled, three_tank
from torch import Tensor

from fdi_torch import Pipe, Plant, Sensor, Tank
from fdi_torch.config.monitor_file import MonitorConfig
from fdi_torch.config.plant_file import load_plant
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import Source
from fdi_torch.config.resolved_config import resolve
from fdi_torch.config.run_file import load_run
from fdi_torch.effects import all_placements, build_network, placements_for
from fdi_torch.estimate.fitting import set_up
from fdi_torch.estimate.hybrid import HybridResult, estimate_parameters
from fdi_torch.jobs.run_setup import fitting_of, recordings_of, requested_space
from fdi_torch.monitor.monitor_settings import MonitorSettings, usual_settings
from fdi_torch.monitor.monitor_setup import prepare_monitor
from fdi_torch.monitor.monte_carlo.simulated_runs import moving_commands
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import usual_step
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import emptying_time, length_scale, time_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.equilibrium import equilibrium
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.simulated_recording import clean_readings, with_noise
from fdi_torch.simulate.step_control import StepControl
from fdi_torch.simulate.step_length import commensurate_step, step_ladder
from tests.test_monitor import NAMES, SPACE, followed, recorded, step_to

FAULTS = {"T1.leak.size": 0.2, "P13.plugging.size": 0.3}
scaled_rigs = pytest.mark.parametrize(("metres", "seconds"), [(3.7, 0.23), (0.05, 60.0)])


def experiment(metres: float, seconds: float) -> tuple[PlantDescription, Recording]:
    plant = rescaled(three_tank(), metres, seconds)
    time = torch.arange(201, dtype=torch.float64) * 2.0
    flow = 35e-6 + 25e-6 * ((time // 100.0) % 2 == 0).to(time)
    inputs = torch.stack([flow, 100e-6 - flow], dim=1)
    return plant, blank_recording(plant, inputs * metres**3 / seconds, time * seconds)


def wider(width: float) -> PlantDescription:
    """The three tanks with a diameter `width` times as large: slower, but no higher."""
    plant = three_tank()
    return replace(plant, tanks=tuple(replace(t, area=width**2 * t.area) for t in plant.tanks))


def test_defaults_are_stated_for_the_three_tank_rig() -> None:
    assert (time_scale(load_plant("three_tank")), length_scale(load_plant("three_tank"))) == (1.0, 1.0)


@pytest.mark.parametrize("name", ["three_tank", "dts200", "cascaded_tanks", "quadruple_tank", "three_tank_leak"])
@scaled_rigs
def test_scales_are_those_of_lengths_and_times(name: str, metres: float, seconds: float) -> None:
    usual = load_plant(name)
    other = rescaled(usual, metres, seconds)
    assert time_scale(other) == pytest.approx(seconds * time_scale(usual), rel=1e-14)
    assert length_scale(other) == pytest.approx(metres * length_scale(usual), rel=1e-14)


@scaled_rigs
def test_ranges_of_effects_scale_with_the_rig(metres: float, seconds: float) -> None:
    usual, other = three_tank(), rescaled(three_tank(), metres, seconds)
    for placement in all_placements(usual):
        here = placement.effect.parameters(placement.location, usual)
        there = placement.effect.parameters(placement.location, other)
        for a, b in zip(here, there, strict=True):
            expected = [factor(a.unit, metres, seconds) * x for x in (a.nominal, a.low, a.high, a.std)]
            assert [b.nominal, b.low, b.high, b.std] == pytest.approx(expected, rel=1e-14), (
                f"{placement.prefix}.{a.name}"
            )


def test_nothing_jumps_as_tanks_widen() -> None:
    """Time scales of 9 and 12.25, on either side of a power of ten's square root, 10."""
    narrow, wide = wider(3.0), wider(3.5)
    pace = (3.5 / 3.0) ** 2
    assert time_scale(wide) == pytest.approx(pace * time_scale(narrow), rel=1e-14)
    assert usual_step(wide) == pytest.approx(pace * usual_step(narrow), rel=1e-14)
    for placement in all_placements(narrow):
        for a, b in zip(*(placement.effect.parameters(placement.location, p) for p in (narrow, wide)), strict=True):
            if 0.0 < abs(a.high) < float("inf"):
                assert 1.0 / pace**2 < b.high / a.high < pace**2, f"{placement.prefix}.{a.name}"


def test_steps_are_whole_fractions_or_multiples_of_the_sampling_interval() -> None:
    assert commensurate_step(2.0, 2.0) == 2.0
    assert commensurate_step(0.9, 2.0) == pytest.approx(2.0 / 3.0)
    assert commensurate_step(1.9, 0.4) == pytest.approx(1.6)
    assert [commensurate_step(scale, 1.0) for scale in (0.96, 1.0, 1.04)] == [1.0, 1.0, 1.0]
    assert step_ladder(2.0, 1.0, 12.0) == pytest.approx([10.0, 4.0, 2.0, 1.0, 0.4, 0.2, 0.1, 0.04, 0.02])
    assert step_ladder(2.0, 1.0, 0.01) == [0.01]
    assert step_ladder(0.46, 0.23, 100.0) == pytest.approx([0.23 * s for s in step_ladder(2.0, 1.0, 100.0)])


@cache
def results(metres: float, seconds: float) -> tuple[Tensor, Tensor, HybridResult]:
    """Clean readings, steady levels, and an estimate from noisy readings."""
    plant, blank = experiment(metres, seconds)
    network = build_network(plant, placements_for(FAULTS))
    clean, std = clean_readings(network, blank, FAULTS), torch.full((3,), 1e-3 * metres, dtype=torch.float64)
    recording = with_noise(blank, clean, std, torch.Generator().manual_seed(3), network)
    estimated = estimate_parameters(set_up(plant, [recording], FAULTS))
    return clean, equilibrium(build_network(plant), blank.inputs[0]), estimated


@scaled_rigs
def test_levels_scale_with_the_rig(metres: float, seconds: float) -> None:
    for usual, other in zip(results(1.0, 1.0)[:2], results(metres, seconds)[:2], strict=True):
        torch.testing.assert_close(other / metres, usual, rtol=0.0, atol=1e-12)


@scaled_rigs
def test_faults_and_their_errors_do_not_depend_on_the_rig_s_size(metres: float, seconds: float) -> None:
    usual, other = results(1.0, 1.0)[2], results(metres, seconds)[2]
    assert other.steps == pytest.approx([seconds * step for step in usual.steps], rel=1e-9)
    per_unit = torch.tensor([1.0, 1.0, metres, metres, metres], dtype=torch.float64)  # two faults, three start levels
    apart = (other.estimate.value / per_unit - usual.estimate.value).abs() / usual.estimate.std
    assert float(apart.max()) < 1e-8
    torch.testing.assert_close(other.estimate.std / per_unit, usual.estimate.std, rtol=1e-9, atol=0.0)
    assert other.diagnosis.kind == usual.diagnosis.kind == "multiple faults"


@scaled_rigs
def test_steps_of_a_lane_s_own_scale_with_the_rig(metres: float, seconds: float) -> None:
    found = []
    for m, s in ((1.0, 1.0), (metres, seconds)):
        plant, blank = experiment(m, s)
        own = StepControl.for_fixed_step(0.5 * s, plant)
        assert own.resolution == pytest.approx(0.5 * s)
        network = build_network(plant, placements_for(FAULTS))
        space = ParameterSpace(network.constants[name] for name in FAULTS)
        engine = OwnStepsEngine(network, space, lay_out(blank.stretch(0, 12), plant.channels(), s, own))
        found.append(engine.readings(space.vector(FAULTS)[None]) / m)
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=1e-13)


def test_times_of_a_monitor_that_nobody_chose_follow_the_plant() -> None:
    slow = plant_mapping(rescaled(three_tank(), 1.0, 60.0))
    given = {"recording": {"file": "any.csv"}, "fault_free": ["0 s", "1 h"], "window": {"confirm": "90 s"}}
    config, _, _ = resolve(MonitorConfig, given | {"plant": slow}, Path(), Source("slow.yaml"))
    usual, _, _ = resolve(MonitorConfig, given, Path(), Source("usual.yaml"))
    assert (usual.window.lookback, usual.window.confirm, usual.false_alarms_every) == (300, 90, 20000)
    assert config.window.confirm == 90
    assert (config.window.lookback, config.false_alarms_every) == pytest.approx((18000, 1.2e6), rel=1e-9)
    settings = usual_settings(rescaled(three_tank(), 1.0, 60.0))
    assert (settings.lookback, settings.confirm, settings.longest) == pytest.approx((18000, 3600, 60000), rel=1e-9)


@scaled_rigs
def test_commands_move_at_the_same_samples(metres: float, seconds: float) -> None:
    def moved(m: float, s: float) -> list[float]:
        plant = rescaled(three_tank(), m, s)
        steady, span = torch.ones(2, dtype=torch.float64), torch.tensor(s, dtype=torch.float64)
        controller = moving_commands(plant, steady, 0.1)()
        return [float(controller(torch.zeros(1, 3), span)[0, 0]) for _ in range(300)]

    assert moved(metres, seconds) == moved(1.0, 1.0)


@scaled_rigs
def test_the_monitor_says_the_same_of_a_rig_of_another_size(metres: float, seconds: float) -> None:
    """A start level that is off by metres, beside readings that are off by millimetres, would alarm on small rigs."""
    usual, other = monitored(1.0, 1.0), monitored(metres, seconds)
    assert [kind for kind, *_ in usual][:2] == ["alarm", "isolated"]
    assert [found[:2] for found in other] == [found[:2] for found in usual]
    for (*_, expected), (*_, found) in zip(usual, other, strict=True):
        assert found == pytest.approx(expected, rel=1e-9)


@cache
def monitored(metres: float, seconds: float) -> list[tuple[str, tuple[str, ...], list[float]]]:
    """Kind, faults, and time, sizes and onset of the events along a leak."""
    runs = (recorded(lambda t: SPACE.nominal(), 400, seed=99), recorded(step_to("T3.leak.size", 0.05, 100.0), 200))
    quiet, faulty = (
        Samples(run.time * seconds, run.inputs * metres**3 / seconds, run.readings * metres, run.hold) for run in runs
    )
    # Windows end between two samples, so that rounding does not decide which samples they hold.
    lookback, confirm, longest = 119.5 * seconds, 39.5 * seconds, 399.5 * seconds
    settings = MonitorSettings(lookback, confirm, longest=longest, incipient=False, together=1)
    plant = rescaled(load_plant("three_tank"), metres, seconds)
    learnt = plant.recording(quiet.time, quiet.inputs, quiet.readings)
    every = 20000.0 * seconds
    watch = prepare_monitor(plant, learnt, NAMES, time_between_false_alarms=every, settings=settings).monitor
    _, events = followed(watch, faulty)
    return [(e.kind, e.faults, [e.time / seconds, *e.sizes, (e.onset or 0.0) / seconds]) for e in events]


def test_an_onset_is_sought_within_the_recording() -> None:
    run = load_run(overrides=["estimate.parameters=[T1.leak, T1.leak.onset]", "simulate.duration=400 s"])
    fitting = fitting_of(run, requested_space(run), recordings_of(run))
    assert (fitting.space["T1.leak.onset"].low, fitting.space["T1.leak.onset"].high) == (0.0, 400.0)


def test_a_full_tank_empties_in_twice_the_time_of_its_first_outflow() -> None:
    """Torricelli: the root of the level falls evenly, so that the mean outflow is half of the first one."""
    tank = Tank("A", area="200 cm^2", height="60 cm")
    drain = Pipe("drain", "A", "outside", area="0.6 cm^2", discharge_coefficient=0.6)
    first = 0.6 * 0.6e-4 * math.sqrt(2.0 * 9.81 * 0.6)
    plant = Plant([tank], [drain], sensors=[Sensor("h", "A")])
    assert emptying_time(plant, tank) == pytest.approx(2.0 * 0.02 * 0.6 / first, rel=1e-12)
    assert emptying_time(Plant([tank], sensors=[Sensor("h", "A")]), tank) == math.inf
