"""Gradients of readings on every engine, and a plant as a differential equation for other solvers."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
import torchdiffeq
from torch import Tensor, nn

import fdi_torch
from fdi_torch import Plant, Recording
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network, placements_for
from fdi_torch.estimate.fitting import EngineKind
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.simulate.engine_choice import adaptive_engine, make_engine
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.ode import PlantOde
from fdi_torch.simulate.step_control import StepControl
from tests.rigs import blank_recording, three_tank

NAMES = ("T1.leak.size", "P13.plugging.size", "Q1.pump_lag.time_constant", "h2.sensor_bias.bias", "P32.area")
THETA = torch.tensor([[0.2, 0.1, 6.0, 0.01, 5e-5], [0.05, 0.3, 12.0, -0.02, 6.5e-5]], dtype=torch.float64)
STEPS = torch.tensor([2e-4, 2e-4, 2e-2, 1e-5, 2e-8], dtype=torch.float64)


def recording(samples: int = 21, interval: float = 10.0) -> Recording:
    time = torch.arange(samples, dtype=torch.float64) * interval
    inputs = torch.stack(
        [40e-6 + 30e-6 * (time % 100 < 50).double(), 50e-6 - 20e-6 * (time % 140 < 70).double()], dim=1
    )
    blank = torch.full((samples, 3), torch.nan, dtype=torch.float64)
    return load_plant("three_tank").recording(time, inputs, blank)


def engine_of(kind: str, samples: int = 13) -> Engine:
    network = TankNetwork(load_plant("three_tank"), placements_for(n for n in NAMES if n.count(".") == 2))
    space = ParameterSpace(network.constants[name] for name in NAMES)
    own = StepControl.for_tolerance(1e-8, network.description, 1.0) if kind.startswith("own ") else None
    experiment = lay_out(recording(samples), network.description.channels(), 10.0 if own else 1.0, own)
    if kind == "adaptive":
        return adaptive_engine(network, space, experiment, 0.5)
    return make_engine(network, space, experiment, kind.removeprefix("own "))


def loss(readings: Tensor) -> Tensor:
    """A nonlinear function with as many members as there are lanes."""
    weights = torch.linspace(0.5, 2.0, readings.shape[-2] * 3, dtype=torch.float64).reshape(-1, 3)
    return (torch.sin(3.0 * readings) * weights).sum(dim=(-2, -1))


def differences(function: Callable[[Tensor], Tensor], theta: Tensor) -> Tensor:
    """Gradient (L, P) of one value a lane by central differences of the fourth order."""
    moves = torch.diag(STEPS)
    lanes = torch.cat([theta + n * move for n in (2.0, 1.0, -1.0, -2.0) for move in moves])
    far, near, back, beyond = function(lanes).reshape(4, len(moves), len(theta)).unbind()
    return ((8.0 * (near - back) - (far - beyond)) / (12.0 * STEPS[:, None])).T


@pytest.mark.parametrize("kind", ["reference", "adaptive", "traced", "compiled", "own compiled"])
def test_gradients_equal_differences(kind: str) -> None:
    engine = engine_of(kind, 4 if kind == "adaptive" else 13)
    at = THETA[:1] if kind == "adaptive" else THETA  # the adaptive solver runs lane by lane
    theta = at.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(engine.readings(theta)).sum(), theta)
    with torch.no_grad():
        wanted = differences(lambda t: loss(engine.readings(t)), at)
    # Four samples see nothing of one of the parameters: its slope is a rounding error of the others' 1e-3 to 1e3.
    scale = wanted.abs().amax(dim=0).clamp(min=1e-12)
    assert float(((slope - wanted).abs() / scale).max()) < 1e-6


def test_all_engines_have_one_gradient() -> None:
    slopes = []
    for kind in ("reference", "traced", "compiled"):
        theta = THETA.clone().requires_grad_()
        slopes.append(torch.autograd.grad(loss(engine_of(kind).readings(theta)).sum(), theta)[0])
    assert torch.allclose(slopes[1], slopes[2], rtol=1e-9) and torch.allclose(slopes[0], slopes[2], rtol=1e-4)


@pytest.mark.parametrize("kind", ["traced", "compiled"])
def test_a_gradient_flows_through_what_lies_around_and_is_taken_once(kind: str) -> None:
    engine = engine_of(kind)
    raw = torch.zeros(5, dtype=torch.float64, requires_grad=True)
    value = loss(engine.readings(THETA[0] + STEPS * raw))
    (slope,) = torch.autograd.grad(value, raw, create_graph=True)
    assert slope.shape == (5,) and bool((slope != 0).all())
    with pytest.raises(RuntimeError, match=f"expected a first derivative of the {kind} engine's readings"):
        torch.autograd.grad(slope.sum(), raw)


@pytest.mark.parametrize("kind", ["traced", "compiled"])
def test_what_has_no_gradient_refuses_instead_of_losing_it(kind: str) -> None:
    engine = engine_of(kind)
    theta = THETA.clone().requires_grad_()
    data = Readings(*(torch.zeros(13, 3, dtype=torch.float64),) * 2)
    for call in (engine.levels, engine.linearise, lambda t: engine.moments(t, data), lambda t: engine.gram(t, data)):
        with pytest.raises(ValueError, match="without requires_grad on the"):
            call(theta)
    with torch.no_grad():
        assert not engine.readings(theta).requires_grad and engine.levels(theta).shape == (2, 13, 3)
    assert not engine.readings(THETA).requires_grad


@pytest.mark.parametrize("kind", ["reference", "traced", "compiled"])
@pytest.mark.parametrize(
    ("theta", "got"),
    [
        ([0.1, 0.1, 0.1, 0.1, 0.1], "got list"),
        (torch.ones(5, dtype=torch.int64), "got torch.int64 of shape \\(5,\\)"),
        (torch.ones(2, 6, dtype=torch.float64), "got torch.float64 of shape \\(2, 6\\)"),
        (torch.tensor(0.1), "got torch.float32 of shape \\(\\)"),
    ],
    ids=["list", "whole numbers", "too wide", "scalar"],
)
def test_parameters_that_do_not_fit_are_named_with_the_remedy(kind: str, theta: object, got: str) -> None:
    engine = engine_of(kind)
    for call in (engine.readings, engine.levels, engine.linearise):
        with pytest.raises(ValueError, match=f"theta: expected .* {got}; write torch.tensor"):
            call(theta)


def test_the_second_derivative_exists_on_the_reference_engine() -> None:
    theta = THETA[:1].clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(engine_of("reference", 3).readings(theta)).sum(), theta, create_graph=True)
    assert torch.autograd.grad(slope[0, 0], theta)[0].abs().sum() > 0


@pytest.mark.parametrize(("hold", "interval"), [("zero_order", "1 s"), ("linear", "0.25 s")])
def test_another_solver_gives_the_engine_s_levels(hold: str, interval: str) -> None:
    """The engine takes the mean of an input over each step, which is the input itself where that is held."""
    plant = load_plant("three_tank")
    inputs = {"Q1": {"steps": [["0 s", "40 cm^3/s"], ["20 s", "70 cm^3/s"]]}, "Q2": "50 cm^3/s"}
    start = {"T1": "40 cm", "T2": "20 cm", "T3": "30 cm"}
    timing = {"duration": "40 s", "sample_time": interval}
    played = fdi_torch.simulate(plant, inputs=inputs, faults={"T1.leak": 0.2}, start_levels=start, hold=hold, **timing)
    theta = {"T1.leak.size": 0.2, "T1.start_level": 0.4, "T2.start_level": 0.2, "T3.start_level": 0.3}
    ode = plant.ode(played, theta)
    jumps = {"jump_t": played.time[1:-1]}
    levels = torchdiffeq.odeint(ode, ode.start, played.time, rtol=1e-9, atol=1e-10, options=jumps)
    assert float((levels - played.outputs).abs().max()) < 1e-6


@pytest.mark.parametrize("effect", [{}, {"link.pipe_inertia": 5.0}, {"link.pipe_inertia": 5.0, "A.leak": 0.3}])
@pytest.mark.parametrize("start", [None, 0.2])
def test_an_ode_starts_where_simulate_does(start: float | None, effect: dict[str, float]) -> None:
    """The levels of a tank without start level, and the states of effects, show in the readings of the first second."""
    plant = fdi_torch.Plant(
        tanks=[
            fdi_torch.Tank("A", area="200 cm^2", height="60 cm"),
            fdi_torch.Tank("B", area="300 cm^2", height="60 cm", start_level=start),
        ],
        pipes=[
            fdi_torch.Pipe("link", "A", "B", area="0.6 cm^2", discharge_coefficient=0.6),
            fdi_torch.Pipe("drain", "B", "outside", area="0.9 cm^2", discharge_coefficient=0.6),
        ],
        pumps=[fdi_torch.Pump("Q", "A", max_flow="6 l/min")],
        sensors=[fdi_torch.Sensor("hA", "A"), fdi_torch.Sensor("hB", "B")],
    )
    faults = {name: f"{value} m" if "inertia" in name else value for name, value in effect.items()}
    steps = {"steps": [["0 s", "3 l/min"], ["20 s", "5 l/min"]]}
    played = fdi_torch.simulate(plant, inputs={"Q": steps}, duration="40 s", sample_time="1 s", faults=faults)
    ode = plant.ode(played, effect)
    torch.testing.assert_close(ode.start[:2], played.outputs[0], rtol=0.0, atol=1e-9)
    levels = torchdiffeq.odeint(
        ode, ode.start, played.time, rtol=1e-8, atol=1e-10, options={"jump_t": played.time[1:-1]}
    )
    assert float((levels[:, :2] - played.outputs).abs().max()) < 1e-5
    assert float(plant.ode(played, effect | {"A.start_level": 0.31}).start[0]) == 0.31


def test_an_ode_takes_constant_inputs_functions_and_batches() -> None:
    plant = load_plant("three_tank")
    inputs = torch.tensor([50e-6, 50e-6], dtype=torch.float64)
    rest = fdi_torch.equilibrium(fdi_torch.build_network(plant), inputs)
    t = torch.tensor(0.0, dtype=torch.float64)
    assert float(plant.ode(inputs)(t, rest).abs().max()) < 1e-9
    size = torch.tensor([0.0, 0.1, 0.3], dtype=torch.float64, requires_grad=True)
    rates = plant.ode(lambda t: inputs, {"T1.leak": size, "P13.area": 6e-5})(t, rest.expand(3, 3))
    assert rates.shape == (3, 3) and bool((rates[0] > rates[2])[0])
    (slope,) = torch.autograd.grad(rates.sum(), size)
    assert bool((slope < 0).all())
    mixed = torch.tensor(30.0, dtype=torch.float64)
    on = plant.ode(inputs, {"T1.leak.size": 0.2, "T1.leak.onset": 30.0})
    assert float(on(mixed - 1.0, rest)[0]) > float(on(mixed + 1.0, rest)[0])


def test_a_held_input_of_an_ode_has_its_new_value_from_the_sample_on() -> None:
    plant, time = three_tank(), torch.arange(3, dtype=torch.float64)
    flows = torch.tensor([[1e-5, 0.0], [4e-5, 0.0], [4e-5, 0.0]], dtype=torch.float64)
    ode = PlantOde(build_network(plant), blank_recording(plant, flows, time))
    before, at = (ode(torch.tensor(t, dtype=torch.float64), ode.start)[0] for t in (0.9, 1.0))
    assert float(at - before) == pytest.approx(3e-5 / 160e-4)


def test_an_ode_refuses_what_it_cannot_be() -> None:
    plant = load_plant("three_tank")
    with pytest.raises(ValueError, match=r"actuators without memory or dead time, got Q1\.pump_lag"):
        plant.ode(torch.zeros(2), {"Q1.pump_lag.time_constant": 5.0})
    with pytest.raises(ValueError, match="expected inputs of Q1, Q2, got a tensor of shape"):
        plant.ode(torch.zeros(3))
    with pytest.raises(ValueError, match="expected a parameter"):
        plant.ode(torch.zeros(2), {"T1.areo": 5.0})


class Fitted(nn.Module):
    """A rig with two unknown shares of one module's parameters, by the compiled engine."""

    def __init__(self, engine: Engine) -> None:
        super().__init__()
        self.engine = engine
        self.raw = nn.Parameter(torch.full((4, 2), -2.0, dtype=torch.float64))

    def forward(self) -> Tensor:
        return self.engine.readings(torch.sigmoid(self.raw))


def test_a_batch_of_plants_trains_inside_a_module() -> None:
    plant: Plant = load_plant("three_tank")
    names = ["T1.leak.size", "P13.plugging.size"]
    engine = fdi_torch.set_up(plant, recording(), names, "equilibrium").engines(10.0)[0]
    truth = torch.tensor([[0.1, 0.3], [0.2, 0.2], [0.3, 0.1], [0.05, 0.05]], dtype=torch.float64)
    measured = engine.readings(truth)
    module = Fitted(engine)
    optimiser = torch.optim.LBFGS(module.parameters(), max_iter=60, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        error = 1e4 * (module() - measured).square().mean()
        error.backward()
        return error

    optimiser.step(closure)  # type: ignore[arg-type]
    assert torch.allclose(torch.sigmoid(module.raw), truth, atol=2e-3)


@pytest.mark.parametrize("kind", ["compiled", "traced", "reference"])
def test_an_engine_prints_what_it_simulates(kind: str) -> None:
    engine = engine_of(kind)
    names, samples = engine.space.names, len(engine.experiment.sample_times)  # type: ignore[attr-defined]
    shown = repr(engine)
    assert shown.startswith(f"{kind} engine: ") and f"{samples} samples" in shown
    assert f"columns of theta: {', '.join(names)}" in shown


@pytest.mark.parametrize(
    ("step", "text"),
    [(10.0, "steps of 10 s"), (7.0, "steps of 5 s"), (4.0, "steps of 3.33 s"), (25.0, "steps of 20 s")],
)
def test_an_engine_says_the_step_that_it_takes(step: float, text: str) -> None:
    """A step ends at every sample and switch, every 10 s and 20 s here; the given one is the longest allowed."""
    inputs = {"Q1": {"steps": [["0 s", "50 cm^3/s"], ["20 s", "70 cm^3/s"]]}, "Q2": "40 cm^3/s"}
    played = fdi_torch.simulate("three_tank", inputs=inputs, duration="40 s", sample_time="10 s")
    (engine,) = fdi_torch.set_up("three_tank", played, ["T1.leak"], "equilibrium").engines(step)
    assert f", {text}" in repr(engine)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_theta_of_either_precision_is_taken_and_a_wrong_one_is_shown_its_own(dtype: torch.dtype) -> None:
    engine = engine_of("compiled")
    assert engine.readings(THETA.to(dtype)).dtype == dtype
    with pytest.raises(ValueError, match=rf"got {dtype} of shape \(1, 1\); write .*, dtype={dtype}\)"):
        engine.readings(torch.zeros(1, 1, dtype=dtype))


@pytest.mark.parametrize("kind", ["reference", "compiled"])
def test_an_onset_at_a_sample_has_the_slope_of_a_later_one(kind: EngineKind) -> None:
    """Two steps meet there; the shift of the onset must not count in both."""
    steps = {"Q1": {"steps": [["0 s", "50 cm^3/s"], ["20 s", "70 cm^3/s"]]}, "Q2": "40 cm^3/s"}
    played = fdi_torch.simulate("three_tank", inputs=steps, duration="60 s")
    for ramp in (0.0, 7.0):
        names = ["T1.leak.onset", "T1.leak.ramp", "T1.leak.size"]
        fitting = fdi_torch.set_up(load_plant("three_tank"), played, names, "equilibrium", kind)
        (engine,) = fitting.engines(1.0)
        at = torch.tensor([[30.0, ramp, 0.3]], dtype=torch.float64)
        theta = at.clone().requires_grad_(True)
        (slope,) = torch.autograd.grad(engine.readings(theta).sum(), theta)
        later = at + torch.tensor([1e-4, 0.0, 0.0], dtype=torch.float64)
        difference = (engine.readings(later).sum() - engine.readings(at).sum()) / 1e-4
        assert float(slope[0, 0]) == pytest.approx(float(difference), rel=1e-4)
