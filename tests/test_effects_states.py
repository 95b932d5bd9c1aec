"""Effects with integrated states of their own: contracts for each of them, and the rigid water column against closed
forms.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from fdi_torch.effects import EFFECTS, all_placements, build_network, place
from fdi_torch.estimate.fitting import set_up
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.monitor.detection import make_detector
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.noise_model import learn_noise
from fdi_torch.monitor.samples import samples_of_recording
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.description import Pipe, PlacedEffect, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Effect, Local, Placement, Stage, Values
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.operating_range import OperatingRange, operating_range_of
from fdi_torch.recording import Recording
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.engine_choice import make_engine
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.ode import PlantOde
from fdi_torch.simulate.step_control import StepControl
from tests.own_steps import OwnStepsEngine
from tests.rigs import blank_recording

NOISE, STEP = 1e-3, 0.25  # m, s
PLANT = PlantDescription(
    "two tanks",
    (Tank("A", 0.01, 0.6, 0.3), Tank("B", 0.01, 0.6, 0.2)),
    (Pipe("AB", "A", "B", 2e-4, 0.8), Pipe("OUT", "B", "outside", 0.6e-4, 0.6)),
    (Pump("P", "A", 1e-4),),
    (Sensor("a", "A"), Sensor("b", "B")),
    tolerances={"AB.discharge_coefficient": 0.03, "OUT.discharge_coefficient": 0.03},
)
PLACES = [p for p in all_placements(PLANT) if p.effect.states]
each_place = pytest.mark.parametrize("placement", PLACES, ids=[p.prefix for p in PLACES])
FIRSTS = {p.effect.name: p for p in reversed(PLACES)}  # of each effect the first place
at_the_first_place = pytest.mark.parametrize("placement", FIRSTS.values(), ids=FIRSTS)


def recording_of(plant: PlantDescription, samples: int = 200) -> Recording:
    """The pump steps at random every 20 s; readings each second."""
    generator = torch.Generator().manual_seed(1)
    flows = 20e-6 + 60e-6 * torch.rand(samples // 20, 1, generator=generator, dtype=torch.float64)
    blank = blank_recording(plant, flows.repeat_interleave(20, dim=0), torch.arange(samples, dtype=torch.float64))
    return replace(blank, outputs=simulated(plant, blank), mask=None)


def simulated(plant: PlantDescription, recording: Recording) -> Tensor:
    network = build_network(plant)
    engine = make_engine(network, ParameterSpace(), lay_out(recording, plant.channels(), STEP), "traced")
    return engine.readings(torch.zeros(0, dtype=torch.float64))


def noisy(recording: Recording, seed: int = 2) -> Recording:
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(recording.outputs.shape, generator=generator, dtype=torch.float64)
    return replace(recording, outputs=recording.outputs + NOISE * noise)


@cache
def reach() -> OperatingRange:
    return operating_range_of(recording_of(PLANT), PLANT)


def start_of(placement: Placement) -> dict[str, float]:
    return placement.effect.starts(placement.location, PLANT, reach())[-1]


def with_effect(placement: Placement) -> PlantDescription:
    """The plant with the effect at its last start."""
    return replace(PLANT, effects=(PlacedEffect(placement.effect.name, placement.location, start_of(placement)),))


def test_there_are_such_effects_and_they_have_states_in_a_network() -> None:
    assert [e.name for e in EFFECTS if e.states]
    network = build_network(PLANT, PLACES)
    assert network.order == 2 + sum(p.effect.states for p in PLACES)


@pytest.mark.slow
@at_the_first_place
def test_adaptive_steps_agree_with_short_fixed_steps(placement: Placement) -> None:
    plant = with_effect(placement)
    recording, network = recording_of(plant, 100), build_network(plant)
    control = StepControl.for_tolerance(1e-6, plant, STEP)
    adaptive = replace(lay_out(recording, plant.channels(), 1.0), step_control=control)
    space = ParameterSpace(network.constants[n] for n in ("AB.discharge_coefficient",))
    theta = space.nominal()
    experiment = replace(adaptive, resolution=theta.new_tensor(STEP))
    exact = make_engine(network, space, lay_out(recording, plant.channels(), STEP), "compiled").linearise(theta)[1]
    for engine in (OwnStepsEngine, CompiledEngine):
        readings, slopes = engine(network, space, experiment).linearise(theta)
        assert torch.allclose(readings, recording.outputs, rtol=0.0, atol=2e-4)
        assert torch.allclose(slopes, exact, rtol=0.0, atol=2e-2 * float(exact.abs().max()))


@each_place
def test_collocation_agrees_with_the_engines_and_completes_levels(placement: Placement) -> None:
    plant = with_effect(placement)
    recording, network = recording_of(plant), build_network(plant)
    names = [n for n in network.constants.names if n.startswith(placement.prefix)] + ["A.start_level"]
    space = ParameterSpace(network.constants[n] for n in names)
    experiment, theta = lay_out(recording, plant.channels(), STEP), space.nominal().unsqueeze(0)
    collocation = Collocation(network, space, experiment)
    fit = collocation.converge(theta)
    levels = fit.levels[..., :2]  # of the tanks alone
    for _ in range(6):
        levels, _ = collocation.corrected(theta, levels)
    assert torch.allclose(levels, fit.levels, rtol=0.0, atol=1e-6)
    assert fit.levels.shape[-1] == network.order and float(fit.defect.max()) < 1e-6
    readings, slopes = make_engine(network, space, experiment, "compiled").linearise(theta)
    assert torch.allclose(fit.readings, readings, rtol=0.0, atol=1e-4)
    scale = slopes.abs().amax((0, 1, 2))
    assert torch.allclose(fit.jacobian / scale, slopes / scale, rtol=0.0, atol=1e-2)


@each_place
def test_the_ode_is_that_of_the_engines(placement: Placement) -> None:
    plant = with_effect(placement)
    network = build_network(plant)
    ode = PlantOde(network, torch.tensor([5e-5], dtype=torch.float64))
    assert ode.start.shape == (network.order,)
    rates = ode(torch.tensor(0.0), ode.start)
    assert rates.shape == (network.order,)
    assert float(rates[2:].abs().max()) < 1e-14  # in steady state at the start, up to rounding


@pytest.mark.slow
@each_place
def test_training_recovers_its_size(placement: Placement) -> None:
    truth = start_of(placement)
    recording = noisy(recording_of(with_effect(placement)))
    network = build_network(PLANT, [placement])
    space = ParameterSpace(network.constants[f"{placement.prefix}.{name}"] for name in truth)
    fitting = set_up(PLANT, [recording], space, ["equilibrium"], "compiled")
    engine, theta = fitting.engines(0.25)[0], space.vector({})
    for _ in range(6):  # Gauss-Newton on the engine's own Jacobian
        readings, slopes = engine.linearise(theta)
        jacobian, residual = slopes.flatten(0, 1), (recording.outputs - readings).flatten()
        theta = torch.minimum(
            (theta + torch.linalg.lstsq(jacobian, residual.unsqueeze(1)).solution[:, 0]).clamp(min=0.0), space.high()
        )
    std = NOISE * torch.linalg.inv(jacobian.T @ jacobian).diagonal().sqrt()
    assert bool(((theta - torch.tensor(list(truth.values()))).abs() < 3.0 * std).all())


@pytest.mark.slow
@at_the_first_place
def test_gap_names_it(placement: Placement) -> None:
    recording = noisy(recording_of(with_effect(placement), 600))
    answer = diagnose(
        PLANT, recording, settings=Settings(library=(placement.effect.name, "leak", "plugging", "pump_lag"))
    )
    (cause,) = answer.causes
    assert (cause.effect, cause.location) == (placement.effect.name, placement.location)
    for name, amount in cause.parameters.items():
        assert amount.std is not None and abs(amount.value - start_of(placement)[name]) < 3.0 * amount.std


@at_the_first_place
def test_the_monitor_runs_beside_it_and_finds_a_leak(placement: Placement) -> None:
    plant = with_effect(placement)
    network = build_network(plant, [place("leak", "B")])
    names = ("B.leak.size", "B.leak.onset")
    space = ParameterSpace(network.constants[n] for n in names[:1])
    free = noisy(recording_of(plant))
    leak = ParameterSpace(network.constants[n] for n in names)
    experiment = lay_out(free, plant.channels(), STEP)
    leaking = make_engine(network, leak, experiment, "traced").readings(torch.tensor([0.3, 80.0], dtype=torch.float64))
    run = noisy(replace(free, outputs=leaking), 3)
    noise, seen = learn_noise(network, samples_of_recording(free, plant), space, space.nominal(), longest_step=0.25)
    assert seen.state.shape[-1] > 2 and noise.gain.steady.shape == (network.order, 2)
    assert noise.reading_std.tolist() == pytest.approx([NOISE] * 2, rel=0.3)
    detector = make_detector("cusum", 20000.0, 1.0, 2, torch.Generator().manual_seed(0))
    settings = MonitorSettings(lookback=120.0, confirm=40.0, longest=400.0, incipient=False, together=1)
    monitor, samples = Monitor(network, space, noise, detector, settings), samples_of_recording(run, plant)
    state, events = monitor.start(samples), []
    for first in range(1, len(samples), 20):
        state, news = monitor.advance(state, samples.segment(first, min(first + 20, len(samples))))
        events += news
    assert [event.kind for event in events][:2] == ["alarm", "isolated"]
    assert 80.0 <= events[0].time < 120.0
    assert events[1].faults == ("B.leak.size",) and abs(events[1].sizes[0] - 0.3) < 4.0 * events[1].stds[0]


def test_flow_is_established_as_the_hyperbolic_tangent_of_time() -> None:
    """Q = Q_0 tanh(t / 2 tau) after a valve opens under a constant head x, with Q_0 = K sqrt(x) and tau = L Q_0 / (2 g
    a x) (Wylie & Streeter, 1993, ch. 1). The level of the tank below is its integral, 2 tau Q_0 ln cosh(t / 2 tau) / A.
    """
    head, area, length = 0.5, 1e-4, 40.0
    plant = PlantDescription(
        "valve",
        (Tank("A", 1e4, 1.0, head), Tank("B", 0.05, 1.0, 0.0)),
        (Pipe("AB", "A", "B", area, 0.6, free_fall=True, valve="v"),),
        (),
        (Sensor("b", "B"),),
        effects=(PlacedEffect("pipe_inertia", "AB", {"length": length}),),
    )
    time = torch.arange(41, dtype=torch.float64)
    blank = blank_recording(plant, (time >= 1.0).to(torch.float64).unsqueeze(1), time)
    level = simulated(plant, blank)[1:, 0]
    flow = 0.6 * area * math.sqrt(2.0 * 9.81 * head)
    twice = length * flow / (9.81 * area * head)
    expected = twice * flow / 0.05 * torch.log(torch.cosh((time[1:] - 1.0) / twice))
    assert torch.allclose(level, expected, rtol=0.0, atol=1e-3 * float(expected[-1]))


def test_two_joined_tanks_oscillate_with_the_period_of_a_u_tube() -> None:
    """Period 2 pi sqrt(L / (g a (1/A_1 + 1/A_2))), which friction changes in second order only."""
    length, area = 50.0, 1e-3
    plant = PlantDescription(
        "U-tube",
        (Tank("A", 0.01, 1.0, 0.51), Tank("B", 0.01, 1.0, 0.5)),
        (Pipe("AB", "A", "B", area, 5.0),),
        (),
        (Sensor("a", "A"), Sensor("b", "B")),
        effects=(PlacedEffect("pipe_inertia", "AB", {"length": length}),),
    )
    time = torch.arange(0.0, 200.0, 0.1, dtype=torch.float64)
    readings = simulated(plant, blank_recording(plant, torch.zeros(len(time), 0, dtype=torch.float64), time))
    head = readings[:, 0] - readings[:, 1]
    crossings = ((head[1:] * head[:-1]) < 0.0).nonzero().flatten()
    instants = time[crossings] + 0.1 * head[crossings] / (head[crossings] - head[crossings + 1])
    period = 2.0 * float(torch.diff(instants)[:4].mean())
    assert period == pytest.approx(2.0 * math.pi * math.sqrt(length / (9.81 * area * 200.0)), rel=0.01)


class SideChamber(Effect):
    """A chamber of `size` tank cross-sections beside a tank, its level c behind the tank's: dc/dt = (h - c) / lag."""

    name, stage, places, states = "side_chamber", Stage.BALANCE, ("tank",), 1

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return Parameter("size", "1", 0.0, 0.0, 2.0), Parameter("lag", "s", 20.0, 1.0, 100.0)

    def steady_states(self, flow: Tensor, local: Local, p: Values) -> tuple[Tensor, ...]:
        return (local.level,)

    def state_rates(self, flow: Tensor, local: Local, p: Values) -> tuple[Tensor, ...]:
        return ((local.level - local.states[0]) / torch.maximum(p["lag"], local.clock.resolution),)

    def inflow(self, local: Local, p: Values) -> Tensor:
        return -p["size"] * local.area * self.state_rates(torch.zeros_like(local.level), local, p)[0]


@pytest.mark.parametrize("kind", ["reference", "traced", "compiled", "collocation"])
def test_a_chamber_beside_a_tank_fills_as_its_closed_form(kind: str) -> None:
    """With the pump's flow q from t = 0 on: d' = q / A - (1 + s) d / lag for d = h - c, and h + s c grows by q / A."""
    area, size, lag, pumped = 0.01, 0.5, 20.0, 2e-5
    plant = PlantDescription(
        "chamber", (Tank("T-1", area, 0.6, 0.1),), (), (Pump("P", "T-1", 1e-4),), (Sensor("a", "T-1"),)
    )
    network = TankNetwork(plant, [Placement(SideChamber(), "T-1", {"size": size, "lag": lag})])
    time = torch.arange(61, dtype=torch.float64)
    blank = blank_recording(plant, torch.full((61, 1), pumped, dtype=torch.float64), time)
    experiment, theta = lay_out(blank, plant.channels(), STEP), torch.zeros(0, dtype=torch.float64)
    if kind == "collocation":
        readings = Collocation(network, ParameterSpace(), experiment).converge(theta.unsqueeze(0)).readings[0]
    else:
        readings = make_engine(network, ParameterSpace(), experiment, kind).readings(theta)
    behind = pumped * lag / (area * (1.0 + size)) * (1.0 - torch.exp(-(1.0 + size) * time / lag))
    expected = 0.1 + (pumped / area * time + size * behind) / (1.0 + size)
    assert torch.allclose(readings[:, 0], expected, rtol=0.0, atol=1e-5)
    assert PlantOde(network, torch.zeros(1, dtype=torch.float64)).start.tolist() == pytest.approx([0.1, 0.1])


def test_states_are_refused_where_nothing_integrates_them() -> None:
    class Wall(SideChamber):
        name, stage = "wall", Stage.STORAGE

    with pytest.raises(ValueError, match=r"A\.wall: expected states only in a BALANCE effect, or in a FLOW effect"):
        TankNetwork(PLANT, [Placement(Wall(), "A")])
    network = build_network(PLANT, PLACES[:1])
    with pytest.raises(ValueError, match="expected 2 levels or a state of 3 numbers, got 4"):
        network.split([torch.zeros(())] * 4)
