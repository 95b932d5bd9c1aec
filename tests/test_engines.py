"""Agreement of the engines with torchdiffeq, of Jacobians with differences, and of sums with their terms."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from rigs import assert_lanes_stand_alone
from torch import Tensor

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import EFFECTS, all_placements, placements_for
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Memory, Placement, Stage, Values
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.recording import Hold, Recording
from fdi_torch.simulate import build
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.compiled_engine import CompiledEngine, _kernel
from fdi_torch.simulate.engine import Readings, gram_of, moments_of
from fdi_torch.simulate.engine_choice import adaptive_engine, make_engine
from fdi_torch.simulate.experiment import Experiment, lay_out
from fdi_torch.simulate.expression import Graph
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.traced_engine import TracedEngine
from fdi_torch.simulate.tracer import Tracer

PAPER = ("T1.leak.size", "OUT2.net_outlet.size", "T3.leak.size", "P13.openness.size", "P32.openness.size")


class SlowPump(Effect):
    """First-order lag with a dead time."""

    name, stage, places, memory, delays = "slow_pump", Stage.COMMAND, ("pump", "valve"), 1, True

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("size", "s", 0.0, 0.0, 60.0), Parameter("dead_time", "s", 0.0, 0.0, 60.0))

    def delay(self, p: Values) -> Tensor:
        return p["dead_time"]

    def steady_memory(self, value: Tensor, p: Values) -> Memory:
        return (value,)

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        kept = torch.exp(-clock.step / torch.clamp(p["size"], min=1e-3))
        now = value + (memory[0] - value) * kept
        return 0.5 * (now + memory[0]), (now,)


class SlowSensor(Effect):
    """A reading that follows slowly and late."""

    name, stage, places, memory, delays = "slow_sensor", Stage.READING, ("sensor",), 1, True

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("size", "s", 0.0, 0.0, 60.0), Parameter("dead_time", "s", 0.0, 0.0, 60.0))

    def delay(self, p: Values) -> Tensor:
        return p["dead_time"]

    def steady_memory(self, value: Tensor, p: Values) -> Memory:
        return (value,)

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        kept = p["size"] / (p["size"] + clock.step)
        now = value + (memory[0] - value) * kept
        return now, (now,)


def rig(names: tuple[str, ...] = PAPER) -> tuple[TankNetwork, ParameterSpace]:
    network = TankNetwork(load_plant("three_tank"), placements_for(n for n in names if n.count(".") == 2))
    return network, ParameterSpace(network.constants[n] for n in names)


def slow_rig() -> tuple[TankNetwork, ParameterSpace]:
    network = TankNetwork(
        load_plant("three_tank"),
        [Placement(SlowPump(), "Q1"), Placement(SlowPump(), "Q2"), *(Placement(SlowSensor(), h) for h in ("h1", "h3"))],
    )
    names = ("Q1.slow_pump.size", "Q1.slow_pump.dead_time", "h1.slow_sensor.size", "h1.slow_sensor.dead_time")
    names += ("h3.slow_sensor.dead_time", "P13.area", "T1.start_level", "Q2.slow_pump.dead_time")
    space = ParameterSpace(network.constants[n] for n in names)
    nominal = space["P13.area"].nominal  # a far wider pipe than the regularised root was drawn for is chaotic
    return network, space.with_changes("P13.area", low=0.5 * nominal, high=1.5 * nominal)


def recording(time: Tensor, hold: Hold = "zero_order", seed: int = 0) -> Recording:
    """Two pumps that switch now and then."""
    generator = torch.Generator().manual_seed(seed)
    inputs = 30e-6 + 50e-6 * torch.rand(len(time), 2, generator=generator, dtype=torch.float64)
    every = torch.arange(len(time)) // 12 * 12
    units = ("m^3/s", "m^3/s"), ("m", "m", "m")
    return Recording(
        time, inputs[every], torch.zeros(len(time), 3).double(), ("Q1", "Q2"), ("h1", "h2", "h3"), *units, hold=hold
    )


def regular(step: float, samples: int) -> Tensor:
    return step * torch.arange(samples, dtype=torch.float64)


def irregular(samples: int) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    return torch.cumsum(0.3 + 9.0 * torch.rand(samples, generator=generator, dtype=torch.float64), 0)


EXPERIMENTS = {
    "samples at steps": (regular(10.0, 60), "zero_order", 10.0),
    "steps between samples": (regular(10.0, 60), "linear", 4.0),
    "samples denser than steps": (regular(1.0, 300), "zero_order", 5.0),
    "linear and dense": (regular(1.0, 300), "linear", 5.0),
    "irregular": (irregular(120), "zero_order", 3.0),
}


# The plant with delays and slow sensors has all that one without them has; of that, times of every kind are enough.
EVERYWHERE = [(slow_rig, name) for name in EXPERIMENTS] + [(rig, "irregular")]


def experiment(name: str = "samples at steps") -> Experiment:
    time, hold, step = EXPERIMENTS[name]
    return lay_out(recording(time, hold), ("Q1", "Q2"), step)


def random_theta(space: ParameterSpace, count: int, seed: int = 0) -> Tensor:
    """Uniform in the whole box, its edges now and then."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(count, len(space), generator=generator, dtype=torch.float64) * 1.1 - 0.05
    low, high = space.low().clamp(min=-1e3), space.high().clamp(max=1e3)
    return low + (high - low) * share.clamp(0.0, 1.0)


def relative(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().max() / b.abs().max())


@pytest.mark.parametrize(("make", "name"), EVERYWHERE)
def test_engines_agree_with_torchdiffeq(make, name: str) -> None:
    network, space = make()
    e = experiment(name)
    theta = random_theta(space, 40)
    reference, compiled, traced = (
        ReferenceEngine(network, space, e),
        CompiledEngine(network, space, e),
        TracedEngine(network, space, e),
    )
    truth = reference.readings(theta)
    assert relative(compiled.readings(theta), truth) < 1e-10
    assert relative(traced.readings(theta), truth) < 1e-10
    levels = reference.levels(theta)
    assert relative(compiled.levels(theta), levels) < 1e-10
    assert relative(traced.levels(theta), levels) < 1e-10


def test_the_random_faults_reach_rims_and_floors() -> None:
    network, space = rig()
    levels = CompiledEngine(network, space, experiment()).levels(random_theta(space, 40))
    assert levels.max() > 1.0 and levels.min() < 0.01


@pytest.mark.parametrize(
    ("make", "name"), [(slow_rig, "samples at steps"), (slow_rig, "linear and dense"), (rig, "irregular")]
)
def test_jacobians_agree_with_central_differences(make, name: str) -> None:
    network, space = make()
    compiled, traced = (engine(network, space, experiment(name)) for engine in (CompiledEngine, TracedEngine))
    theta = space.low() + (space.high() - space.low()) * (
        0.3 + 0.4 * torch.rand(20, len(space), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    )
    readings, jacobian = compiled.linearise(theta)
    assert torch.equal(readings, compiled.readings(theta)) or relative(readings, compiled.readings(theta)) < 1e-14
    torch.testing.assert_close(
        jacobian, traced.linearise(theta)[1], rtol=1e-9, atol=1e-10 * float(jacobian.abs().max())
    )
    width = 1e-6 * (space.high() - space.low())
    for q in range(len(space)):
        shift = torch.zeros(len(space)).double()
        shift[q] = width[q]
        difference = (compiled.readings(theta + shift) - compiled.readings(theta - shift)) / (2 * width[q])
        error = (jacobian[..., q] - difference).abs().amax((1, 2)) / difference.abs().amax()
        # a lane whose difference spans a kink (a rim, a switch) may differ
        assert float(error.median()) < 1e-7 and float(error.sort().values[-3]) < 1e-4, space.names[q]


def test_the_reference_differentiates_alike() -> None:
    network, space = rig()
    e = lay_out(recording(regular(10.0, 8)), ("Q1", "Q2"), 5.0)
    theta = random_theta(space, 5)
    truth = ReferenceEngine(network, space, e).linearise(theta)[1]
    assert relative(CompiledEngine(network, space, e).linearise(theta)[1], truth) < 1e-10


def test_an_adaptive_solver_gives_the_same_slopes_lane_by_lane() -> None:
    network, space = rig()
    e = lay_out(recording(regular(10.0, 4)), ("Q1", "Q2"), 0.5)
    theta = random_theta(space, 2)
    readings, slopes = adaptive_engine(network, space, e, 0.02).linearise(theta)
    fine = replace(lay_out(recording(regular(10.0, 4)), ("Q1", "Q2"), 0.05), resolution=e.nodes.new_tensor(0.02))
    expected, truth = CompiledEngine(network, space, fine).linearise(theta)
    assert float((readings - expected).abs().max()) < 1e-7
    assert relative(slopes, truth) < 1e-5
    alone = adaptive_engine(network, space, e, 0.02).linearise(theta[1:])[1]
    assert torch.equal(alone[0], slopes[1])


def test_sums_are_those_of_readings_and_jacobian() -> None:
    network, space = rig()
    e = experiment()
    generator = torch.Generator().manual_seed(5)
    theta = random_theta(space, 3 * 21).reshape(3, 21, -1)
    samples = len(e.sample_times)
    values = torch.rand(3, samples, 3, generator=generator, dtype=torch.float64)
    weight = torch.rand(3, samples, 3, generator=generator, dtype=torch.float64)
    weight[:, ::7] = 0.0
    values[:, ::7] = torch.nan
    for data in (Readings(values, weight), Readings(values[0], weight[0])):
        engine = CompiledEngine(network, space, e)
        readings, jacobian = engine.linearise(theta)
        assert relative(engine.moments(theta, data), moments_of(readings, data)) < 1e-12
        assert relative(engine.gram(theta, data), gram_of(readings, jacobian, data)) < 1e-12
        for other in (TracedEngine(network, space, e), ReferenceEngine(network, space, e)):
            assert relative(other.moments(theta, data), moments_of(readings, data)) < 1e-10
        assert relative(TracedEngine(network, space, e).gram(theta, data), gram_of(readings, jacobian, data)) < 1e-10


def test_gram_against_loops() -> None:
    """The definition, written out: weighted products of the columns, without masked readings."""
    generator = torch.Generator().manual_seed(2)
    y, prediction = torch.rand(6, 1, generator=generator).double(), torch.rand(6, 1, generator=generator).double()
    slope = torch.rand(6, 1, 1, generator=generator).double()
    weight = torch.tensor([1.0, 1.0, 0.0, 2.0, 1.0, 1.0], dtype=torch.float64)[:, None]
    data = Readings(y, weight)
    mean = float((y * weight).sum() / weight.sum())
    columns = [[float(slope[k]), float(y[k] - prediction[k]), float(y[k]) - mean, 1.0] for k in range(6)]
    expected = torch.zeros(4, 4, dtype=torch.float64)
    for k in (0, 1, 3, 4, 5):
        expected += float(weight[k]) * torch.outer(*(torch.tensor(columns[k]).double(),) * 2)
    found = gram_of(prediction[None], slope[None], data)[0, 0]
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("make", [rig, slow_rig])
def test_a_lane_depends_on_no_neighbour(make, monkeypatch: pytest.MonkeyPatch) -> None:
    network, space = make()
    e = experiment("samples denser than steps")
    engine = CompiledEngine(network, space, e)
    theta = random_theta(space, 70)
    data = Readings(torch.rand(300, 3).double(), torch.ones(300, 3).double())
    for run in (
        engine.readings,
        engine.levels,
        lambda t: engine.linearise(t)[1],
        lambda t: engine.moments(t, data),
        lambda t: engine.gram(t, data),
    ):
        assert_lanes_stand_alone(run, theta, monkeypatch)


def test_problems_with_one_lane_each_have_their_own_data() -> None:
    network, space = rig()
    e = experiment()
    engine = CompiledEngine(network, space, e)
    theta = random_theta(space, 50).unsqueeze(1)
    readings = engine.readings(theta)[:, 0]
    data = Readings(readings, torch.ones_like(readings))
    assert float(engine.moments(theta, data)[..., 1].max()) == 0.0
    assert float(engine.gram(theta, data)[..., 5, 5].max()) < 1e-25


def test_no_lanes_and_no_parameters() -> None:
    network, _ = rig()
    space = ParameterSpace()
    engine = CompiledEngine(network, space, experiment())
    alone = engine.readings(torch.zeros(0).double())
    assert alone.shape == (60, 3) and bool(torch.isfinite(alone).all())
    assert engine.linearise(torch.zeros(4, 0).double())[1].shape == (4, 60, 3, 0)
    network, space = rig()
    assert CompiledEngine(network, space, experiment()).readings(torch.zeros(0, 5).double()).shape == (0, 60, 3)


def test_float32_is_near_float64() -> None:
    network, space = rig()
    engine = CompiledEngine(network, space, experiment())
    theta = random_theta(space, 40)
    single = engine.readings(theta.float())
    assert single.dtype == torch.float32
    assert relative(single.double(), engine.readings(theta)) < 1e-4


@pytest.mark.parametrize("name", ["three_tank", pytest.param("quadruple_tank", marks=pytest.mark.slow)])
def test_every_effect_survives_every_engine(name: str) -> None:
    """All effects in one plant, each at the first place where it fits; each lane has one of them off nominal."""
    plant = load_plant(name)
    placed = [p for effect in EFFECTS for p in all_placements(plant, [effect])[:1]]
    network = TankNetwork(plant, placed)
    names = [n for n in network.constants.names if n.count(".") == 2]
    space = ParameterSpace(network.constants[n] for n in names)
    e = lay_out(waves(plant), plant.channels(), 2.0)
    low, high = space.low().clamp(min=-10.0), space.high().clamp(max=30.0)
    generator = torch.Generator().manual_seed(4)
    anywhere = low + (high - low) * torch.rand(3, len(placed), len(space), generator=generator, dtype=torch.float64)
    own = torch.tensor([[n.startswith(p.prefix + ".") for n in names] for p in placed])
    theta = torch.where(own, anywhere, space.nominal()).reshape(-1, len(space))
    theta = torch.cat([theta, space.nominal().expand(1, -1)])
    reference = ReferenceEngine(network, space, e)
    nearby = theta * (1.0 + 1e-15)
    truth, nearly = reference.readings(torch.stack([theta, nearby])).unbind()
    compiled, traced = CompiledEngine(network, space, e), TracedEngine(network, space, e)

    def error(readings: Tensor) -> Tensor:
        return ((readings - truth).abs() / truth.abs().amax((1, 2), keepdim=True)).amax((1, 2))

    # a lane that chatters at its rim magnifies the last bit: the reference itself does, when theta moves by one
    tame = error(nearly) < 1e-12
    assert float(tame.double().mean()) > 0.9
    for engine in (compiled, traced):
        wrong = torch.where(tame, error(engine.readings(theta)), 0.0)
        assert float(wrong.max()) < 1e-10, placed[int(wrong.argmax()) % len(placed)].prefix
    jacobian = compiled.linearise(theta[tame])[1]
    other, moved = traced.linearise(torch.stack([theta[tame], nearby[tame]]))[1].unbind()
    assert torch.equal(torch.isfinite(jacobian), torch.isfinite(other))
    scale = other.nan_to_num(posinf=0.0, neginf=0.0).abs().amax((0, 1, 2)) + 1e-300
    # at a kink the last bit decides on which side the slope is taken
    smooth = ~((moved - other).abs() > 1e-6 * scale)
    assert float(smooth.double().mean()) > 0.9999
    torch.testing.assert_close(
        torch.where(smooth, jacobian, other) / scale, other / scale, rtol=1e-8, atol=1e-9, equal_nan=True
    )


def waves(plant: PlantDescription) -> Recording:
    """Every input of a plant up and down within its range."""
    time, channels = regular(2.0, 40), plant.channels()
    wave = torch.stack([0.5 + 0.4 * torch.sin(time / (7 + c)) for c in range(len(channels))], dim=1)
    scale = torch.tensor([next((p.max_flow / p.gain for p in plant.pumps if p.channel == c), 1.0) for c in channels])
    outputs = torch.zeros(40, len(plant.sensors)).double()
    units = tuple(plant.channel_units().values()), tuple(s.unit for s in plant.sensors)
    return Recording(time, wave * scale, outputs, channels, tuple(s.column for s in plant.sensors), *units)


def test_a_compiled_plant_is_found_again_by_plants_that_differ_in_numbers_only(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    plant = load_plant("three_tank")
    e = experiment()
    for gravity, height in ((9.81, 1.0), (9.7, 0.7)):
        tanks = tuple(replace(t, height=height, area=t.area * (1 + i / 7)) for i, t in enumerate(plant.tanks))
        network = TankNetwork(replace(plant, tanks=tanks, gravity=gravity), placements_for(PAPER))
        space = ParameterSpace(network.constants[n] for n in PAPER)
        theta = random_theta(space, 5)
        engine = CompiledEngine(network, space, e)
        assert relative(engine.readings(theta), ReferenceEngine(network, space, e).readings(theta)) < 1e-10
    assert len(list((tmp_path / "fdi_torch").glob("*.so"))) == 1


def test_without_a_compiler_auto_falls_back_and_says_so(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    network, space = rig()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(build, "_packaged_compiler", lambda: None)
    engine = make_engine(network, space, experiment())
    assert engine.name == "traced" and "expected a C++ compiler" in engine.why
    with pytest.raises(BuildError, match="or set CXX"):
        make_engine(network, space, experiment(), "compiled")


def test_a_compiler_that_fails_is_named(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(BuildError, match="to compile the plant"):
        build.load_library("this is no C++")
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    with pytest.raises(BuildError, match="set XDG_CACHE_HOME"):
        build.load_library("int x;")


def test_auto_compiles_where_the_processor_computes() -> None:
    network, space = rig()
    e = experiment()
    assert make_engine(network, space, e).name == "compiled"
    assert make_engine(network, space, e, "reference").name == "reference"
    assert make_engine(network, space, e, "traced").name == "traced"
    assert make_engine(network, space, e, device="cuda").name == "traced"
    with pytest.raises(ValueError, match="on cuda, got compiled, which runs on the CPU"):
        make_engine(network, space, e, "compiled", device="cuda")
    with pytest.raises(ValueError, match="expected an engine of auto"):
        make_engine(network, space, e, "quick")


def test_misuse_is_named() -> None:
    network, space = rig()
    engine = CompiledEngine(network, space, experiment())
    ones = torch.ones(60, 3).double()
    with pytest.raises(ValueError, match="5 columns"):
        engine.readings(torch.zeros(2, 4).double())
    with pytest.raises(ValueError, match="float64 or float32"):
        engine.readings(torch.zeros(2, 5, dtype=torch.float16))
    with pytest.raises(ValueError, match="problems"):
        engine.moments(torch.zeros(2, 3, 5).double(), Readings(ones.expand(4, 60, 3), ones.expand(4, 60, 3)))
    with pytest.raises(ValueError, match="samples and sensors"):
        engine.moments(torch.zeros(3, 5).double(), Readings(ones[:9], ones[:9]))
    with pytest.raises(ValueError, match="one shape"):
        Readings(ones, ones[:5])


def test_what_is_not_pointwise_is_named() -> None:
    tracer = Tracer(Graph())
    x = tracer.tensor(tracer.graph.input("theta", 0, 1))
    with tracer, pytest.raises(ValueError, match="expected pointwise operations"):
        torch.cumsum(x, 0)
    with tracer, pytest.raises(ValueError, match="expected numbers or lanes"):
        x + torch.ones(2)
    with tracer, pytest.raises(ValueError, match="expected plain division"):
        torch.div(x, 2.0, rounding_mode="floor")


@pytest.fixture(autouse=True)
def _fresh_kernels() -> None:
    """So that each test compiles or loads by its own environment."""
    _kernel.cache_clear()
