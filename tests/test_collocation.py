"""Collocation against a sequential recurrence, the reference engine and finite differences."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import fdi_torch
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, place, placements_for
from fdi_torch.parameters import ParameterSpace
from fdi_torch.recording import Recording
from fdi_torch.simulate import array_program
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.output_map import SampleGrid
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.scan import newton_step, scan_in_time
from tests.rigs import blank_recording, constant_inputs, three_tank


def stepped(duration: float = 200.0) -> Recording:
    """Inputs that change every 40 s."""
    blank = constant_inputs(three_tank(), duration)
    inputs = blank.inputs.clone()
    for k, level in enumerate((20e-6, 70e-6, 45e-6, 80e-6, 30e-6)):
        inputs[40 * k : 40 * (k + 1), 0] = level
        inputs[40 * k + 20 : 40 * (k + 1) + 20, 1] = 90e-6 - level
    return replace(blank, inputs=inputs)


@pytest.fixture(params=["compiled", "torch"])
def loop(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both ways through rates and recurrence: compiled where there is a compiler, and torch's."""
    if request.param == "torch":
        monkeypatch.setattr("fdi_torch.simulate.scan._library", lambda tanks: None)
        monkeypatch.setattr("fdi_torch.simulate.array_program._library", lambda: None)
    return request.param


both_loops = pytest.mark.usefixtures("loop")


@pytest.mark.parametrize("tanks", [1, 3, 7])
def test_both_ways_through_a_newton_step_are_one(tanks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(1)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    lanes, steps, columns = 3, 21, 4
    by_level = -draw(lanes, tanks, tanks, steps).abs() / tanks
    by_theta, slopes = draw(lanes, tanks, columns, steps), draw(lanes, tanks, columns)
    path, rates, start = draw(lanes, tanks, steps + 1), draw(lanes, tanks, steps), draw(lanes, tanks)
    path[1, 0, 5] = torch.nan
    given = (draw(steps).abs(), path, rates, by_level, by_theta, start, slopes)
    found = newton_step(*given)
    monkeypatch.setattr("fdi_torch.simulate.scan._library", lambda tanks: None)
    for ours, torchs in zip(found, newton_step(*given), strict=True):
        torch.testing.assert_close(ours, torchs, rtol=1e-10, atol=1e-10, equal_nan=True)


@both_loops
@pytest.mark.parametrize("count", [1, 2, 7, 50])
def test_the_scan_is_the_recurrence(count: int) -> None:
    generator = torch.Generator().manual_seed(1)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    a, b, first = 0.5 * draw(2, 3, 3, count), draw(2, 3, 4, count), draw(2, 3, 4)
    expected = [first]
    for k in range(count):
        expected.append(a[..., k] @ expected[-1] + b[..., k])
    torch.testing.assert_close(scan_in_time(a, b, first), torch.stack(expected, dim=-1), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("columns", [1, 3, 21])
def test_a_scan_with_a_gain_is_one_of_the_product(columns: int, loop: str) -> None:
    generator = torch.Generator().manual_seed(2)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    a, gain, b, first = 0.4 * draw(2, 3, 3, 150), draw(2, 3, 3, 150), draw(2, 3, columns, 150), draw(2, 3, columns)
    b[:, 1] = 0.0
    b[:, 2, :, :80] = 0.0
    state, expected = first, [first]
    for k in range(150):
        state = a[..., k] @ state + gain[..., k] @ b[..., k]
        expected.append(state)
    found = scan_in_time(a, b, first, gain)
    torch.testing.assert_close(found, torch.stack(expected, dim=-1), rtol=1e-12, atol=1e-12)
    alone = scan_in_time(a[:1], b[:1, :, :1], first[:1, :, :1], gain[:1])
    if loop == "compiled":
        assert torch.equal(alone, found[:1, :, :1])


@pytest.mark.parametrize(
    "causes",
    [
        {},
        {("pump_gain", "Q1"): {"factor": 1.1}},
        {("pump_lag", "Q1"): {"time_constant": 9.0}, ("sensor_lag", "h2"): {"time_constant": 12.0}},
        {("pump_delay", "Q2"): {"delay": 7.3}, ("sensor_delay", "h1"): {"delay": 4.6}},
        {("sensor_drift", "h1"): {"rate": 1e-4}},
    ],
)
def test_levels_and_slopes_are_those_of_the_reference_and_of_finite_differences(causes: dict) -> None:
    recording = stepped()
    network = build_network(three_tank(), [place(*cause) for cause in causes])
    values = {f"{at}.{name}.{p}": v for (name, at), ps in causes.items() for p, v in ps.items()}
    names = ["P13.discharge_coefficient", "T1.start_level", *values]
    space = ParameterSpace(network.constants[n] for n in names)
    theta = space.vector(values).unsqueeze(0)
    engine = Collocation(network, space, lay_out(recording, network.description.channels(), 1.0))
    found = engine.converge(theta)
    exact = ReferenceEngine(network, space, lay_out(recording, network.description.channels(), 0.25)).readings(theta)
    assert float((found.readings - exact).abs().max()) < 1e-5  # m
    for j, name in enumerate(names):
        step = 3e-3 * max(abs(float(theta[0, j])), 0.1) * torch.eye(len(names), dtype=torch.float64)[j]
        far, near, back, beyond = (engine.converge(theta + n * step).readings for n in (2.0, 1.0, -1.0, -2.0))
        slope = (8.0 * (near - back) - (far - beyond)) / (12.0 * step[j])
        error = (slope - found.jacobian[..., j]).norm() / slope.norm()
        assert float(error) < 1e-6, name


@both_loops
def test_what_runs_over_a_rim_is_the_references() -> None:
    low = three_tank(start=(0.38, 0.2, 0.3), tank_height=0.4)
    recording = replace(stepped(), inputs=stepped().inputs * 1.1)
    network = build_network(low, [])
    space = ParameterSpace([network.constants["T1.start_level"]])
    theta = space.nominal().unsqueeze(0)
    engine = Collocation(network, space, lay_out(recording, low.channels(), 1.0))
    found = engine.converge(theta)
    exact = ReferenceEngine(network, space, lay_out(recording, low.channels(), 0.25)).readings(theta)
    assert float(exact.max()) > 0.4
    assert float((found.readings - exact).abs().max()) < 1e-3  # m


@pytest.fixture(scope="module")
def kinked() -> tuple[Collocation, Tensor]:
    """Three tanks in a row that overflow and run dry in turn."""
    low = three_tank(start=(0.02, 0.01, 0.01), tank_height=0.25)
    blank = constant_inputs(low, 1500.0)
    inputs = blank.inputs.clone()
    for k in range(0, len(inputs), 300):
        inputs[k : k + 150], inputs[k + 150 : k + 300] = 110e-6, 0.0
    network = build_network(low, [])
    space = ParameterSpace(network.constants[f"T{i}.start_level"] for i in (1, 2, 3))
    theta = torch.cat([space.nominal().unsqueeze(0), 0.5 * space.nominal().unsqueeze(0)])
    engine = Collocation(network, space, lay_out(replace(blank, inputs=inputs), low.channels(), 1.0))
    return engine, theta


def test_a_trajectory_with_kinks_is_that_of_corrections_of_all_steps(
    kinked: tuple[Collocation, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Corrections of all steps at once take hundreds of rounds; without a compiler there is no other way."""
    engine, theta = kinked
    found = engine.converge(theta)
    assert float(found.defect.max()) < 1e-6
    monkeypatch.setattr(array_program, "_library", lambda: None)
    assert torch.allclose(found.levels, engine.converge(theta).levels, rtol=0, atol=1e-9)


@pytest.mark.parametrize("guess", [0.1, math.nan])
def test_a_trajectory_with_kinks_does_not_depend_on_the_guess(kinked: tuple[Collocation, Tensor], guess: float) -> None:
    engine, theta = kinked
    levels = engine.trajectories(theta)
    assert torch.allclose(engine.trajectories(theta, torch.full_like(levels, guess)), levels, rtol=0, atol=1e-9)


def test_a_tank_without_an_outlet_rises_by_what_flows_in() -> None:
    tank, pump = fdi_torch.Tank("A", area="100 cm^2", height="50 cm"), fdi_torch.Pump("Q", "A", max_flow="60 l/min")
    plant = fdi_torch.Plant(tanks=[tank], pumps=[pump], sensors=[fdi_torch.Sensor("h", "A")])
    blank = constant_inputs(plant, 100.0)
    recording = replace(blank, inputs=torch.full_like(blank.inputs, 1e-5))
    network = build_network(plant).without_overflow()
    space = ParameterSpace([network.constants["A.start_level"]])
    theta = torch.tensor([[0.1], [0.2]], dtype=torch.float64)
    levels = Collocation(network, space, lay_out(recording, plant.channels(), 1.0)).trajectories(theta)[..., 0]
    time = torch.arange(levels.shape[1], dtype=torch.float64)
    assert torch.allclose(levels, theta + 1e-3 * time, rtol=0, atol=1e-12)


@pytest.mark.parametrize("crest", [0.5, 1.0])
def test_a_step_over_the_crest_of_a_wide_overflow_is_solved(crest: float) -> None:
    """In steps of 4 s, Newton's method jumps from one side of the crest to the other."""
    plant = load_plant(Path(__file__).parents[1] / "configs" / "real" / "cascaded_tanks_nominal.yaml")
    values = {"upper.overflow.below_rim": 0.19, "upper.overflow.crest": crest, "upper.overflow.to_lower": 0.65}
    time = 4.0 * torch.arange(1000, dtype=torch.float64)
    blank = blank_recording(plant, (3.0 + 2.5 * torch.sin(0.01 * time)).unsqueeze(1), time)
    network = build_network(plant, placements_for(values))
    space = ParameterSpace(network.constants[n] for n in values)
    engine = Collocation(network, space, lay_out(blank, plant.channels(), 4.0))
    assert float(engine.converge(space.vector(values).unsqueeze(0)).defect.max()) < 1e-6


@both_loops
def test_a_tank_simulated_alone_between_the_levels_of_the_others_has_its_own_level() -> None:
    network = build_network(three_tank(), [])
    space = ParameterSpace([network.constants["T1.start_level"]])
    theta = space.nominal().unsqueeze(0)
    engine = Collocation(network, space, lay_out(stepped(80.0), network.description.channels(), 2.0))
    levels = engine.converge(theta).levels
    for tank in range(3):
        guess = levels.clone()
        guess[..., tank] = guess[:, :1, tank]
        assert torch.allclose(engine.simulate_tank(theta, guess, tank), levels, rtol=0, atol=1e-6)


def test_levels_between_nodes_lie_on_the_line_through_them() -> None:
    experiment = lay_out(constant_inputs(three_tank(), 6.0, sample=0.5), ("Q1", "Q2"), 2.0)
    line = 0.1 + 0.02 * experiment.nodes
    assert len(experiment.nodes) < len(experiment.sample_times)
    assert torch.allclose(SampleGrid(experiment).of(line), 0.1 + 0.02 * experiment.sample_times)


def test_a_trajectory_does_not_depend_on_the_other_lanes() -> None:
    network = build_network(three_tank(start=(0.5, 0.3, 0.4)), [])
    space = ParameterSpace([network.constants["P13.discharge_coefficient"]])
    theta = torch.tensor([[0.6], [0.5]], dtype=torch.float64)
    engine = Collocation(network, space, lay_out(stepped(), network.description.channels(), 1.0))
    both = engine.converge(theta)
    for lane in (0, 1):
        alone = engine.converge(theta[lane : lane + 1])
        assert torch.equal(alone.readings[0], both.readings[lane])
