"""Oscillation faults: period from a long window, and phase long after t = 0."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, placements_for
from fdi_torch.monitor.detection import make_detector
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monitor_setup import prepare_monitor, with_shapes
from fdi_torch.monitor.monte_carlo.simulated_runs import FaultSchedule, SimulatedRig, fault_free_schedule
from fdi_torch.monitor.noise_model import learn_noise
from fdi_torch.monitor.oscillation import strongest_periods
from fdi_torch.monitor.samples import Samples
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.equilibrium import equilibrium

PLANT = load_plant("three_tank")
INPUTS = torch.tensor([50e-6, 50e-6], dtype=torch.float64)


def test_the_period_of_a_weak_oscillation_is_among_the_strongest_of_a_long_window() -> None:
    time = torch.arange(2000, dtype=torch.float64)
    noise = torch.randn(2000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    swing = 0.3 * torch.sin(2.0 * math.pi * time / 7.3)
    noise[:, 1] += swing
    found = strongest_periods(noise, 1.0, 4.0, 3600.0, 8)
    # Half a swing of the window apart: periods of 7.3^2 / 4000 = 0.013 s.
    assert float((found - 7.3).abs().min()) < 0.014
    assert strongest_periods(noise[:5], 1.0, 60.0, 60.0, 8).tolist() == [60.0]


def test_a_monitor_for_oscillations_alone_asks_nothing_about_its_fault_free_part() -> None:
    time = torch.arange(120, dtype=torch.float64)
    noise = 1e-3 * torch.randn(120, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    levels = equilibrium(build_network(PLANT, []), INPUTS) + noise
    recording = PLANT.recording(time, INPUTS.expand(120, -1), levels)
    assert prepare_monitor(PLANT, recording, ["Q1.pump_oscillation.amplitude"]).warnings == ()


def test_an_oscillating_pump_is_isolated_a_day_after_the_start() -> None:
    names = with_shapes(["T1.leak.size", "Q1.pump_gain.factor", "Q1.pump_oscillation.amplitude"], PLANT)
    network = build_network(PLANT, placements_for(names))
    space = ParameterSpace(network.constants[n] for n in names)
    std = torch.full((3,), 1e-3, dtype=torch.float64)
    rig = SimulatedRig(network, space, INPUTS, equilibrium(network, INPUTS), std)
    learnt = rig.run(fault_free_schedule(space, 1), 600, torch.Generator().manual_seed(2))
    one = Samples(learnt.time, learnt.inputs, learnt.readings[0])
    noise, _ = learn_noise(network, one, space, space.nominal(), levels=rig.levels)
    detector = make_detector("cusum", 20000.0, 1.0, 3, torch.Generator().manual_seed(0))
    settings = MonitorSettings(lookback=100.0, confirm=60.0, longest=400.0, incipient=False, together=1)
    monitor = Monitor(network, space, noise, detector, settings)
    truth = {"Q1.pump_oscillation.amplitude": 0.1, "Q1.pump_oscillation.period": 40.0, "Q1.pump_oscillation.phase": 0.7}
    still = torch.zeros(1, dtype=torch.float64)
    course = FaultSchedule(space.vector(truth)[None], torch.full((1,), 200.0, dtype=torch.float64), still)
    seen = rig.run(course, 601, torch.Generator().manual_seed(3))
    day = 86400.0 + 13.0
    seen = replace(seen, time=seen.time + day, readings=seen.readings[0])
    state = monitor.start(seen, space.nominal(), rig.levels)
    _, events = monitor.advance(state, seen.segment(1, len(seen)))
    last = [event for event in events if event.faults][-1]
    assert last.faults[0] == "Q1.pump_oscillation.amplitude"
    found = dict(zip(last.faults, zip(last.sizes, last.stds, strict=True), strict=True))
    for name in ("Q1.pump_oscillation.amplitude", "Q1.pump_oscillation.period"):
        size, error = found[name]
        assert abs(size - truth[name]) < 3.5 * error, (name, size, error)
    # Where the swing stands after a day is known to a fraction of a turn, the phase at the clock's zero to many.
    period, phase = found["Q1.pump_oscillation.period"], found["Q1.pump_oscillation.phase"]
    assert phase[1] == pytest.approx(2.0 * math.pi * (day + 400.0) / period[0] ** 2 * period[1], rel=0.1)
    assert -math.pi <= phase[0] <= math.pi
    now, then = day + 500.0, 500.0
    told, true = 2.0 * math.pi * now / period[0] + phase[0], 2.0 * math.pi * then / 40.0 + 0.7
    assert abs(math.remainder(told - true, 2.0 * math.pi)) < 0.5
