"""The plant against closed forms, SciPy, conservation of volume and the paper's equations."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from rigs import REST, blank_recording, constant_inputs, paper_network, random_steps, three_tank
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from torch import Tensor

from fdi_torch.effects import build_network
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import (
    OUTSIDE,
    Pipe,
    PlacedEffect,
    PlantDescription,
    Pump,
    Sensor,
    Tank,
    Transfer,
    Weir,
)
from fdi_torch.plant.inverted_sensor import levels_from_readings
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.orifice import limit_draw, limit_emptying, rim_strength, weir_flow, weir_law
from fdi_torch.plant.signals import Clock, CumulativeSignal
from fdi_torch.simulate.equilibrium import equilibrium
from fdi_torch.simulate.experiment import grid_nodes, lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine


def clock(resolution: float = 1e-6) -> Clock:
    zero, one = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    return Clock(zero, one, one * resolution)


def nothing() -> tuple[ParameterSpace, torch.Tensor]:
    return ParameterSpace(), torch.zeros(1, 0, dtype=torch.float64)


def torricelli_rates(levels: list[float], theta: tuple[float, ...], flow: float = 50e-6) -> list[float]:
    """The paper's (31) with the readings of its errata, written out for SciPy."""
    h1, h2, h3 = levels
    k = 0.6 * 0.6e-4 * math.sqrt(2 * 9.81)

    def root(x: float) -> float:
        return math.copysign(math.sqrt(abs(x)), x)

    q13, q32 = theta[3] * k * root(h1 - h3), theta[4] * k * root(h3 - h2)
    return [
        (flow - q13 - theta[0] * k * root(h1)) / 160e-4,
        (flow + q32 - theta[1] * k * root(h2)) / 160e-4,
        (q13 - q32 - theta[2] * k * root(h3)) / 160e-4,
    ]


def test_a_component_is_looked_up_by_its_name_and_kind() -> None:
    plant = three_tank()
    assert plant.tank("T2") is plant.tanks[1] and plant.sensor("h3") is plant.sensors[2]
    assert plant.pipe("P13") is plant.flow("P13") is plant.pipes[0] and plant.metered_flow("Q2") is plant.pumps[1]
    with pytest.raises(ValueError, match="expected the name of a Tank, got P13"):
        plant.tank("P13")
    with pytest.raises(ValueError, match="expected the name of a MeteredFlow, got OUT2"):
        plant.metered_flow("OUT2")
    with pytest.raises(ValueError, match="expected one of T1, T2, T3"):
        plant.pipe("nowhere")


def test_an_emptying_tank_follows_torricelli() -> None:
    plant = PlantDescription(
        "one", (Tank("T", 0.02, 1.0, 0.8),), (Pipe("O", "T", OUTSIDE, 1e-4, 0.6),), (), (Sensor("h", "T"),)
    )
    rate = 0.6 * 1e-4 * math.sqrt(2 * 9.81) / 0.02
    empty_after = 2.0 * math.sqrt(0.8) / rate
    time = torch.linspace(0.0, 0.9 * empty_after, 50, dtype=torch.float64)
    recording = blank_recording(plant, torch.zeros(50, 0, dtype=torch.float64), time)
    space, theta = nothing()
    engine = ReferenceEngine(build_network(plant), space, lay_out(recording, (), 0.05))
    closed = (math.sqrt(0.8) - 0.5 * rate * time) ** 2
    assert (engine.levels(theta)[0, :, 0] - closed).abs().max() < 1e-9


def test_an_emptied_tank_stays_empty() -> None:
    plant = PlantDescription(
        "one", (Tank("T", 0.02, 1.0, 0.1),), (Pipe("O", "T", OUTSIDE, 1e-4, 0.6),), (), (Sensor("h", "T"),)
    )
    time = torch.linspace(0.0, 2000.0, 200, dtype=torch.float64)
    recording = blank_recording(plant, torch.zeros(200, 0, dtype=torch.float64), time)
    space, theta = nothing()
    levels = ReferenceEngine(build_network(plant), space, lay_out(recording, (), 1.0)).levels(theta)[0, :, 0]
    assert levels.min() > -1e-6
    assert levels[-1].abs() < 1e-6


def test_small_steps_about_rest_follow_the_matrix_exponential() -> None:
    network, space = paper_network()
    inputs = torch.full((2,), 50e-6, dtype=torch.float64)
    rest = equilibrium(network, inputs)
    values = network.bind(space, space.nominal())
    slope = torch.autograd.functional.jacobian(lambda h: network(h, inputs, clock(), values), rest)
    push = torch.tensor([1e-5, -2e-5, 1.5e-5], dtype=torch.float64)
    plant = three_tank(tuple((rest + push).tolist()))
    engine = ReferenceEngine(*paper_network(plant), lay_out(constant_inputs(plant, 100.0, 10.0), ("Q1", "Q2"), 0.1))
    levels = engine.levels(space.nominal().unsqueeze(0))[0]
    for k in range(11):
        expected = rest + torch.from_numpy(expm(10.0 * k * slope.numpy())) @ push
        assert (levels[k] - expected).abs().max() < 1e-9


def test_an_outlet_above_the_level_passes_nothing() -> None:
    plant = PlantDescription(
        "one",
        (Tank("T", 0.02, 1.0, 0.1),),
        (Pipe("O", "T", OUTSIDE, 1e-4, 0.6, elevation=0.3),),
        (),
        (Sensor("h", "T"),),
    )
    recording = blank_recording(plant, torch.zeros(3, 0, dtype=torch.float64), torch.arange(3, dtype=torch.float64))
    space, theta = nothing()
    levels = ReferenceEngine(build_network(plant), space, lay_out(recording, (), 0.5)).levels(theta)
    assert torch.equal(levels, torch.full_like(levels, 0.1))


@pytest.mark.parametrize("levels", [(0.5, 0.1), (0.1, 0.5), (0.5, 0.4), (0.2, 0.1)])
def test_a_raised_pipe_is_driven_by_the_water_above_it(levels: tuple[float, float]) -> None:
    """Torricelli with the water above a pipe at 0.3 m: a level below it is no head."""
    plant = PlantDescription(
        "two",
        (Tank("A", 0.02, 1.0), Tank("B", 0.02, 1.0)),
        (Pipe("P", "A", "B", 1e-4, 0.6, elevation=0.3),),
        (),
        (Sensor("h", "A", gain=2.0, offset=0.1),),
    )
    network = build_network(plant)
    state = torch.tensor(levels, dtype=torch.float64)
    rates = network(state, state[:0], clock(), network.bind(*(nothing()[0], state[:0])))
    head = max(levels[0] - 0.3, 0.0) - max(levels[1] - 0.3, 0.0)
    flow = 0.6 * 1e-4 * math.copysign(math.sqrt(2 * 9.81 * abs(head)), head)
    assert (0.02 * rates).tolist() == pytest.approx([-flow, flow], rel=1e-6, abs=1e-12)


def test_a_reading_is_gain_times_level_plus_offset_and_shows_its_level() -> None:
    plant = replace(three_tank(), sensors=(Sensor("h1", "T1", gain=2.0, offset=0.1),))
    network, level = build_network(plant), torch.tensor(0.4, dtype=torch.float64)
    values = network.bind(ParameterSpace(), level.new_zeros(0))
    (reading,), _ = network.read([level], (), clock(), values)
    assert float(reading) == pytest.approx(2.0 * 0.4 + 0.1)
    shown = levels_from_readings(network, [reading], [0.0 * level] * 3, 0.0 * level, values)
    assert [float(h) for h in shown] == pytest.approx([0.4, 0.0, 0.0])


@pytest.mark.parametrize("draw", [1e-3, 1e-5])
def test_a_tank_that_is_drawn_empty_loses_no_more_than_it_holds(draw: float) -> None:
    """The law -2 h / step, 0 below the floor, leads the 3/8 rule from h to h (1 - (2 + 3 (2/3 + 2)) / 8) = -h / 4."""
    tanks = (Tank("A", 0.02, 1.0, 0.01), Tank("B", 0.02, 1.0, 0.0))
    plant = PlantDescription("two", tanks, (), (), (Sensor("h", "A"),), transfers=(Transfer("Q", "A", "B", 1e-2),))
    time = 5.0 * torch.arange(9, dtype=torch.float64)
    recording = blank_recording(plant, torch.full((9, 1), draw, dtype=torch.float64), time)
    space, theta = nothing()
    levels = ReferenceEngine(build_network(plant), space, lay_out(recording, ("Q",), 5.0)).levels(theta)[0]
    assert bool((levels[:, 0] >= -0.01 / 4 - 1e-12).all()) and bool((levels[1:, 0] <= levels[:-1, 0]).all())
    assert torch.allclose(levels.sum(1), torch.full_like(levels[:, 0], 0.01), rtol=1e-12)


def test_rest_is_where_the_paper_reading_has_it() -> None:
    network, _ = paper_network()
    rest = equilibrium(network, torch.full((2,), 50e-6, dtype=torch.float64))
    assert (rest - torch.tensor(REST, dtype=torch.float64)).abs().max() < 1e-6


@pytest.mark.parametrize("first", [0.0, 6e-11, 1e-8])
def test_tanks_beyond_a_pump_that_hardly_runs_rest_at_the_level_of_their_neighbour(first: float) -> None:
    plant = three_tank()
    outlet = next(p for p in plant.pipes if p.target is None or p.target == "outside")
    rest = equilibrium(build_network(plant), torch.tensor([first, 84e-6], dtype=torch.float64))
    level = ((84e-6 + first) / (outlet.discharge_coefficient * outlet.area)) ** 2 / (2.0 * plant.gravity)
    assert rest.tolist() == pytest.approx([level] * 3, rel=1e-6)


@pytest.mark.parametrize("theta", [(0.3, 0.3, 0.5, 0.6, 1.0), (0.1, 0.6, 0.0, 1.0, 1.0)])
def test_agrees_with_scipy(theta: tuple[float, ...]) -> None:
    plant = three_tank()
    network, space = paper_network(plant)
    experiment = replace(
        lay_out(constant_inputs(plant, 1000.0, 20.0), plant.channels(), 20.0),
        resolution=torch.tensor(1e-6, dtype=torch.float64),
    )
    engine = ReferenceEngine(network, space, experiment, method="dopri5", rtol=1e-12, atol=1e-14)
    levels = engine.levels(torch.tensor([theta], dtype=torch.float64))[0]
    truth = solve_ivp(
        lambda t, h: torricelli_rates(h, theta),
        (0, 1000),
        REST,
        "LSODA",
        experiment.sample_times.numpy(),
        rtol=1e-12,
        atol=1e-14,
    )
    assert (levels - torch.from_numpy(truth.y.T)).abs().max() < 1e-10


def test_fourth_order_of_convergence() -> None:
    plant = three_tank((0.8, 0.2, 0.5))
    network, space = paper_network(plant)
    recording = constant_inputs(plant, 100.0, 100.0)
    sharp = torch.tensor(1e-6, dtype=torch.float64)

    def final(step: float) -> torch.Tensor:
        experiment = replace(lay_out(recording, plant.channels(), step), resolution=sharp)
        return ReferenceEngine(network, space, experiment).levels(space.nominal().unsqueeze(0))[0, -1]

    truth = final(0.1)
    coarse, fine = (final(step) - truth for step in (10.0, 5.0))
    slope = torch.log2(coarse.norm() / fine.norm())
    assert 3.7 < float(slope) < 4.4


def test_volume_is_conserved() -> None:
    plant = three_tank((0.9, 0.95, 0.5))
    network, space = paper_network(plant)
    theta = torch.tensor([[0.2, 0.7, 0.3, 0.5, 0.9]], dtype=torch.float64)
    values = network.bind(space, theta[0])
    levels = torch.tensor([0.9, 1.02, 0.5], dtype=torch.float64)
    commands = torch.tensor([40e-6, 90e-6], dtype=torch.float64)
    now = network.operating_point(levels.unbind(), commands.unbind(), clock(), values)
    flows = network.flows(now)
    net = torch.stack(network.less_overflow(now, network.net_inflows(now, flows)))
    k = 0.6 * 0.6e-4 * math.sqrt(2 * 9.81)
    leaks = 0.2 * k * math.sqrt(0.9) + 0.3 * k * math.sqrt(0.5)
    crest = 2.0 * math.sqrt(math.pi * 160e-4)
    spill = (2.0 / 3.0) * 0.6 * math.sqrt(2 * 9.81) * crest * 0.02**1.5
    assert float(net.sum()) == pytest.approx(130e-6 - leaks - spill - 0.7 * k * math.sqrt(1.02), rel=1e-6)


def test_gradients_pass_gradcheck_off_and_on_equal_levels() -> None:
    network, space = paper_network()
    commands = torch.tensor([40e-6, 60e-6], dtype=torch.float64)
    theta = torch.tensor([0.2, 0.7, 0.3, 0.5, 0.9], dtype=torch.float64, requires_grad=True)

    def scaled(levels: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
        return 1e3 * network(levels, commands, clock(1.0), network.bind(space, parameters))

    apart = torch.tensor([0.6, 0.3, 0.5], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(scaled, (apart, theta), eps=1e-7)
    for special in ([0.0, 0.0, 0.0], [0.4, 0.4, 0.4], [0.3, 0.5, 0.6], [1.0, 1.0, 1.0]):
        levels = torch.tensor(special, dtype=torch.float64, requires_grad=True)
        gradients = torch.autograd.grad(scaled(levels, theta).sum(), (levels, theta))
        assert all(bool(torch.isfinite(g).all()) for g in gradients)


def lpv_form(
    network: TankNetwork, space: ParameterSpace, levels: Tensor, commands: Tensor, step: Clock
) -> tuple[Tensor, Tensor]:
    """F (tanks, P) and B (tanks, actuators) of x' = F(x) theta + B u (2020 paper, eq. 32, 33), at one operating point.

    The right-hand side is affine in the sizes of leaks, net outlets and openness, and in commands within the pumps'
    limits, unless a tank is empty or at its rim.
    """

    def rates(theta: Tensor, u: Tensor) -> Tensor:
        return network(levels, u, step, network.bind(space, theta))

    return torch.autograd.functional.jacobian(rates, (space.nominal(levels), commands))


def test_lpv_form_is_the_papers() -> None:
    network, space = paper_network()
    levels = torch.tensor([0.5, 0.2, 0.35], dtype=torch.float64)
    commands = torch.tensor([40e-6, 60e-6], dtype=torch.float64)
    f, b = lpv_form(network, space, levels, commands, clock())
    k = 0.6 * 0.6e-4 * math.sqrt(2 * 9.81) / 160e-4
    q13, q32 = k * math.sqrt(0.15), k * math.sqrt(0.15)
    printed = torch.tensor(
        [
            [-k * math.sqrt(0.5), 0, 0, -q13, 0],
            [0, -k * math.sqrt(0.2), 0, 0, q32],
            [0, 0, -k * math.sqrt(0.35), q13, -q32],
        ],
        dtype=torch.float64,
    )
    assert torch.allclose(f, printed, rtol=1e-9, atol=1e-15)
    assert torch.allclose(b, torch.tensor([[62.5, 0], [0, 62.5], [0, 0]], dtype=torch.float64))
    theta = torch.tensor([0.2, 0.7, 0.3, 0.5, 0.9], dtype=torch.float64)
    right = network(levels, commands, clock(), network.bind(space, theta))
    assert torch.allclose(f @ theta + b @ commands, right, rtol=1e-9, atol=0)


def test_averages_of_a_held_signal_are_exact() -> None:
    time = torch.tensor([0.0, 1.0, 3.0, 4.0], dtype=torch.float64)
    values = torch.tensor([[2.0], [5.0], [1.0], [7.0]], dtype=torch.float64)
    signal = CumulativeSignal(time, values, "zero_order")
    mean = signal.average(torch.tensor(0.5, dtype=torch.float64), torch.tensor(3.0, dtype=torch.float64), 0)
    assert float(mean) == pytest.approx((0.5 * 2 + 2 * 5 + 0.5 * 1) / 3)
    late = signal.average(torch.tensor(0.5, dtype=torch.float64), torch.tensor(3.0, dtype=torch.float64), 0, 1.0)
    assert float(late) == pytest.approx((1.5 * 2 + 1.5 * 5) / 3)


def test_switches_between_steps_are_hit() -> None:
    plant = three_tank()
    recording = random_steps(plant, 300.0, seed=3, sample=7.3)
    experiment = lay_out(recording, plant.channels(), 2.0)
    changed = (torch.diff(recording.inputs, dim=0).abs().sum(1) > 0).nonzero().flatten() + 1
    for instant in recording.time[changed]:
        assert float((experiment.nodes - instant).abs().min()) < 1e-9


def test_square_roots_are_smoothed_for_the_longest_step() -> None:
    plant, time = three_tank(), torch.tensor([0.0, 1.0, 2.0, 7.0], dtype=torch.float64)
    switched = torch.tensor([0.0, 0.0, 1e-5, 1e-5], dtype=torch.float64).unsqueeze(1).expand(4, 2)
    layout = lay_out(blank_recording(plant, switched, time), plant.channels(), 5.0)
    assert float(layout.steps.min()) < float(layout.resolution) == float(layout.steps.max())


def test_samples_denser_than_steps_are_interpolated() -> None:
    plant = three_tank((0.8, 0.2, 0.5))
    network, space = paper_network(plant)
    theta = space.nominal().unsqueeze(0)
    recording = constant_inputs(plant, 50.0, 0.1)
    sharp = torch.tensor(1e-6, dtype=torch.float64)
    coarse, fine = (replace(lay_out(recording, plant.channels(), step), resolution=sharp) for step in (2.0, 0.1))
    assert len(coarse.nodes) == 26
    levels = [ReferenceEngine(network, space, experiment).levels(theta) for experiment in (coarse, fine)]
    assert (levels[0] - levels[1]).abs().max() < 2e-8


def test_overflow_goes_where_the_plant_says() -> None:
    plant = PlantDescription(
        "two",
        (Tank("U", 0.02, 0.3, 0.3, overflow_to="L"), Tank("L", 0.02, 1.0, 0.0)),
        (),
        (Pump("Q", "U", 1e-4),),
        (Sensor("h", "L"),),
    )
    time = torch.linspace(0.0, 100.0, 11, dtype=torch.float64)
    recording = blank_recording(plant, torch.full((11, 1), 5e-5, dtype=torch.float64), time)
    space, theta = nothing()
    levels = ReferenceEngine(build_network(plant), space, lay_out(recording, plant.channels(), 0.1)).levels(theta)[0]
    assert float(levels.sum(1)[-1]) == pytest.approx(0.3 + 5e-5 * 100 / 0.02, rel=1e-9)
    assert 0.3 < float(levels[-1, 0]) < 0.31


def test_a_weir_follows_poleni() -> None:
    """Q = (2/3) C_d b sqrt(2 g) x^(3/2) at x = 9 cm above the crest."""
    tanks = (Tank("A", 0.02, 1.0), Tank("B", 0.02, 1.0))
    plant = PlantDescription("two", tanks, (), (), (Sensor("h", "A"),), weirs=(Weir("W", "A", "B", 0.2, 0.05, 0.6),))
    network, levels = build_network(plant), torch.tensor([0.29, 0.0], dtype=torch.float64)
    rates = network(levels, levels[:0], clock(), network.bind(ParameterSpace(), levels[:0]))
    flow = 2.0 / 3.0 * 0.6 * 0.05 * math.sqrt(2 * 9.81) * 0.09**1.5
    assert (0.02 * rates).tolist() == pytest.approx([-flow, flow], rel=1e-6)


def test_the_slope_of_the_flow_over_a_rim_is_its_derivative() -> None:
    excess, one = torch.tensor(0.04, dtype=torch.float64, requires_grad=True), torch.ones((), dtype=torch.float64)
    flow, slope = weir_law(excess, 3.0 * one)
    (derivative,) = torch.autograd.grad(flow, excess)
    assert float(slope.detach()) == pytest.approx(float(derivative), rel=1e-6)


def test_in_endless_steps_a_brimful_tank_spills_and_a_dry_one_gives_what_flows_in() -> None:
    excess, inflow, one = (torch.tensor(x, dtype=torch.float64) for x in (1e-3, 2e-4, 1.0))
    assert float(weir_flow(excess, inflow, 0.02 * one, 0.8 * one, 1e12 * one)) == pytest.approx(2e-4)
    assert float(limit_draw(one, excess, inflow, 0.02 * one, 1e12 * one)) == pytest.approx(2e-4)


@pytest.mark.parametrize("error", [-1e-19, 0.0, 1e-19])
def test_rounding_errors_do_not_change_the_slopes_of_a_tank_at_rest_on_its_floor(error: float) -> None:
    level, one = torch.zeros((), dtype=torch.float64, requires_grad=True), torch.ones((), dtype=torch.float64)
    emptying = limit_emptying(error - 0.1 * level, level, one)
    drawn = limit_draw(0.1 * level - error, level, 0.0 * one, one, one)
    for limited, slope in ((emptying, -0.1), (drawn, 0.1)):
        assert torch.autograd.grad(limited, level)[0].item() == slope


def test_nothing_runs_over_a_rim_that_is_not_reached_however_coarse_the_steps() -> None:
    metres, inflow, area = torch.tensor([-0.1, 0.0, 0.1], dtype=torch.float64), 5e-5, torch.tensor(160e-4).double()
    spill = weir_flow(metres, inflow, area, rim_strength(area, torch.tensor(9.81).double()), torch.tensor(1e5).double())
    assert spill[:2].tolist() == [0.0, 0.0] and float(spill[2]) > 0.99 * inflow


@pytest.mark.parametrize(("every", "hit"), [(11.0, True), (9.0, False)])
def test_switches_are_step_ends_unless_they_come_faster_than_half_a_step(every: float, hit: bool) -> None:
    time = torch.arange(1000, dtype=torch.float64)
    commands = (time // every % 2).unsqueeze(1)
    nodes = set(grid_nodes(time, commands, "zero_order", 20.0).tolist())
    switches = set(torch.arange(every, 999.0, every, dtype=torch.float64).tolist())
    assert switches <= nodes if hit else len(switches & nodes) < 0.2 * len(switches)


def test_at_rest_a_tank_that_nothing_feeds_is_empty() -> None:
    """A constant draw from it would take the level below its floor."""
    draw = PlacedEffect("unmetered_flow", "T3", {"flow": -5e-6, "begin": 0.0, "duration": 1e9})
    plant = replace(three_tank(), effects=(draw,))
    assert equilibrium(build_network(plant), torch.zeros(2, dtype=torch.float64)).tolist() == pytest.approx([0.0] * 3)


def test_a_pump_delivers_nothing_for_a_negative_command_and_no_more_than_it_can() -> None:
    plant = three_tank((0.2, 0.2, 0.0))
    time = torch.arange(0.0, 110.0, 10.0, dtype=torch.float64)
    commands = torch.tensor([[-50e-6, 1.0]], dtype=torch.float64).expand(len(time), 2)
    space, theta = nothing()
    network = build_network(replace(plant, pipes=(), tanks=tuple(replace(t, leak_reference=None) for t in plant.tanks)))
    levels = ReferenceEngine(network, space, lay_out(blank_recording(plant, commands, time), ("Q1", "Q2"), 1.0)).levels(
        theta
    )
    assert levels[0, -1].tolist() == pytest.approx([0.2, 0.2 + 90e-6 * 100.0 / 160e-4, 0.0])


def test_a_tank_without_an_outlet_rests_above_its_rim() -> None:
    plant = PlantDescription("closed", (Tank("T", 0.02, 1.0, None),), (), (Pump("Q", "T", 1e-4),), (Sensor("h", "T"),))
    strength = rim_strength(*torch.tensor([0.02, plant.gravity], dtype=torch.float64))
    rest = equilibrium(build_network(plant), torch.tensor([5e-5], dtype=torch.float64))
    assert float(rest - 1.0) == pytest.approx(float(5e-5 / strength) ** (2.0 / 3.0), rel=1e-3)


def test_that_no_steady_state_is_found_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdi_torch.simulate.equilibrium.MOST_STEPS", 3)
    with pytest.raises(ValueError, match=r"level of tank T\d keeps changing; give its start_level"):
        equilibrium(build_network(three_tank()), torch.tensor([5e-5, 0.0], dtype=torch.float64))


def test_unknown_inputs_must_be_masked() -> None:
    plant = three_tank()
    recording = constant_inputs(plant, 10.0)
    recording.inputs[4, 1] = float("nan")
    with pytest.raises(ValueError, match="missing one at 4 s; mask that segment"):
        lay_out(recording, plant.channels(), 1.0)
    assert [len(r) for r in recording.known_segments()] == [4, 6]
