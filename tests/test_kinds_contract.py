"""Contract tests of every kind of flow component; authors of kinds need not write them."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from own_steps import OwnStepsEngine
from rigs import blank_recording, factor, rescaled
from torch import Tensor

import fdi_torch
from fdi_torch.config.plant_file import build_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.yaml_files import parse_yaml
from fdi_torch.effects import build_network, place
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import FLOW_KINDS, OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.flow_component import FlowComponent, FlowOrder
from fdi_torch.plant.kinds.transfer import Transfer
from fdi_torch.plant.kinds.weir import Weir
from fdi_torch.plant.signals import Clock
from fdi_torch.recording import Recording
from fdi_torch.report.schematic import schematic
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.engine import Engine
from fdi_torch.simulate.engine_choice import make_engine
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.step_control import StepControl

SAMPLE, SAMPLES = 2.5, 80
AREA, HEIGHT = 0.015, 0.5
kinds = pytest.mark.parametrize("kind", FLOW_KINDS, ids=lambda kind: kind.__name__)


def plant_with(kind: type[FlowComponent], start: tuple[float, float] = (0.25, 0.25)) -> PlantDescription:
    """A pump into A, one component of the kind from A to B, one from B to the outside, and a small outlet of each."""
    tanks = (Tank("A", AREA, HEIGHT, start[0]), Tank("B", AREA, HEIGHT, start[1]))
    outlets = (Pipe("OUTA", "A", OUTSIDE, 0.15e-4, 0.6), Pipe("OUTB", "B", OUTSIDE, 0.15e-4, 0.6))
    plant = PlantDescription(
        f"a plant with a {kind.__name__}", tanks, outlets, (Pump("Q", "A", 7e-5),), (Sensor("a", "A"), Sensor("b", "B"))
    )
    present = getattr(plant, kind.part())
    return replace(plant, **{kind.part(): (*present, kind.example("X", "A", "B"), kind.example("Y", "B", OUTSIDE))})


def inputs_of(plant: PlantDescription) -> Recording:
    """Every channel between 10 and 60 % of its full scale."""
    full = {c.input_channel[0]: c.full_command for c in plant.flow_components() if c.input_channel is not None}
    steps = torch.rand(SAMPLES // 10, len(full), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    scale = torch.tensor([full[channel] for channel in plant.channels()], dtype=torch.float64)
    values = scale * (0.1 + 0.5 * steps.repeat_interleave(10, dim=0))
    return blank_recording(plant, values, torch.arange(SAMPLES, dtype=torch.float64) * SAMPLE)


@cache
def levels_of(kind: type[FlowComponent], step: float = SAMPLE) -> Tensor:
    """Levels (S, tanks) of the kind's plant by the reference engine."""
    plant = plant_with(kind)
    network = build_network(plant)
    experiment = lay_out(inputs_of(plant), plant.channels(), step)
    return ReferenceEngine(network, ParameterSpace(), experiment).levels(network.nominal.new_zeros(0))


@kinds
def test_a_plant_file_describes_it_completely(kind: type[FlowComponent]) -> None:
    plant = plant_with(kind)
    assert build_plant(parse_yaml(dump_plant(plant).encode(), "plant"), "plant") == plant


@kinds
def test_each_key_has_a_meaning_and_each_constant_a_parameter(kind: type[FlowComponent]) -> None:
    component = kind.example("X", "A", "B")
    constants = build_network(plant_with(kind)).constants
    assert component.constants()
    for name, unit, role in component.constants():
        parameter = constants[f"X.{name}"]
        assert parameter.unit == unit and parameter.nominal == getattr(component, name)
        assert role in ("estimated", "constant")


@kinds
def test_it_is_drawn_under_its_name(kind: type[FlowComponent]) -> None:
    texts = {text.get_text() for text in schematic(plant_with(kind)).axes[0].texts}
    assert {"X", "Y"} <= texts


@kinds
def test_it_changes_the_levels(kind: type[FlowComponent]) -> None:
    plant = plant_with(kind)
    others = tuple(c for c in getattr(plant, kind.part()) if c.name not in ("X", "Y"))
    without = replace(plant, **{kind.part(): others})
    recording = inputs_of(plant)
    kept = [plant.channels().index(channel) for channel in without.channels()]
    recording = blank_recording(without, recording.inputs[:, kept], recording.time)
    network = build_network(without)
    engine = ReferenceEngine(network, ParameterSpace(), lay_out(recording, without.channels(), SAMPLE))
    assert (engine.levels(network.nominal.new_zeros(0)) - levels_of(kind)).abs().max() > 1e-3


@kinds
@pytest.mark.parametrize("levels", [(0.3, 0.1), (0.1, 0.3), (0.2, 0.2), (0.0, 0.1), (1e-4, 0.0), (0.55, 0.45)])
def test_the_target_receives_what_the_source_loses(kind: type[FlowComponent], levels: tuple[float, float]) -> None:
    """At any levels: dry, equal, above the rim."""
    plant = plant_with(kind)
    network = build_network(plant)
    values = network.bind(ParameterSpace(), network.nominal.new_zeros(0))
    resolution = torch.tensor(SAMPLE, dtype=torch.float64)
    clock = Clock(torch.zeros_like(resolution), resolution, resolution)
    channels = inputs_of(plant).inputs[0]
    commands = [channels[index] for _, index in network.actuators()]
    now = network.operating_point([torch.tensor(h, dtype=torch.float64) for h in levels], commands, clock, values)
    first = network.flows(now)
    gathered = network.net_inflows(now, first)
    last, net = network.last_flows(now, gathered)
    flows = first | last
    ends = {c.name: (c.source, c.target) for c in plant.flow_components()}
    crossing = sum(flows[n] * ((s == OUTSIDE) - float(t == OUTSIDE)) for n, (s, t) in ends.items())
    assert float(sum(net)) == pytest.approx(float(crossing), abs=1e-15)
    for component in plant.flow_components():
        if levels[0] == 0.0 and component.source == "A" and component.order > FlowOrder.BY_LEVELS:
            assert float(flows[component.name]) <= max(float(gathered[0]), 0.0) + 1e-18, "a dry tank loses water"


class Drained:
    """One tank that only a component of the kind drains, with steps so long that a full tank empties `per_step` times
    in one of them. smoothing: the resolution relative to the step, 1 unless a test is to fail.
    """

    def __init__(self, kind: type[FlowComponent], per_step: float, smoothing: float = 1.0) -> None:
        self.component = kind.example("X", "A", OUTSIDE)
        bare = PlantDescription(
            "one tank", (Tank("A", AREA, HEIGHT, 0.5 * HEIGHT),), (), (Pump("Q", "A", 1.0),), (Sensor("a", "A"),)
        )
        self.plant = replace(bare, **{kind.part(): (self.component,)})
        self.network = build_network(self.plant)
        self.values = self.network.bind(ParameterSpace(), self.network.nominal.new_zeros(0))
        self.full = self.outflow(HEIGHT, 1e-9)
        self.step = per_step * AREA * HEIGHT / self.full
        self.resolution = smoothing * self.step

    def outflow(self, level: float, resolution: float) -> float:
        """Flow at a level (m) without any inflow, m^3/s; a commanded one is commanded in full."""
        t = torch.tensor(resolution, dtype=torch.float64)
        full = {c.name: c.full_command for c in self.plant.flow_components()} | {"Q": 0.0}
        commands = [torch.tensor(full[name], dtype=torch.float64) for name, _ in self.network.actuators()]
        levels = [torch.tensor(level, dtype=torch.float64)]
        now = self.network.operating_point(levels, commands, Clock(0 * t, t, t), self.values)
        return float(self.network.flow(now, self.component, torch.zeros_like(t)))

    def level_of(self, flow: float) -> float:
        """The level at which the law without smoothing gives a flow (m^3/s), m."""
        low, high = 0.0, HEIGHT
        for _ in range(200):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.outflow(middle, 1e-12) < flow else (low, middle)
        return high

    def slope(self, level: float) -> float:
        """dQ/dh of the law without smoothing, m^2/s."""
        above = 1e-6 * HEIGHT
        return (self.outflow(level + above, 1e-12) - self.outflow(level, 1e-12)) / above

    def levels(self, inflow: float) -> Tensor:
        """Levels (S,) by steps of fixed length under a constant inflow (m^3/s), until the tank has settled."""
        slope = self.slope(self.level_of(inflow))
        count = 400 if slope * self.step <= 0.0 else max(400, math.ceil(SETTLED * AREA / (slope * self.step)))
        given = {"Q": inflow, "X": self.component.full_command}
        channels = torch.tensor([given[c] for c in self.plant.channels()], dtype=torch.float64)
        time = torch.arange(count, dtype=torch.float64) * self.step
        experiment = lay_out(
            blank_recording(self.plant, channels.expand(count, -1), time), self.plant.channels(), self.step
        )
        experiment = replace(experiment, resolution=experiment.resolution.new_tensor(self.resolution))
        engine = ReferenceEngine(self.network, ParameterSpace(), experiment)
        return engine.levels(self.network.nominal.new_zeros(0))[:, 0]


draining = pytest.mark.parametrize(
    "kind", [k for k in FLOW_KINDS if k.example("X", "A", OUTSIDE).source == "A"], ids=lambda kind: kind.__name__
)
PER_STEP, SHARES = (0.1, 1.0, 10.0), (0.003, 0.03)
LONG = (10.0, 1.0)  # of these; shorter steps are nearer to the law, and need many to settle
SETTLED = 12.0  # time constants of the tank after which it has settled
FASTEST = 1.5  # rate x step up to which explicit steps need no smoothing; RK4 is stable to 2.785


def smoothing_error(kind: type[FlowComponent], smoothing: float = 1.0) -> float:
    """Greatest relative error of the flow at levels that one step moves by less than their distance from the kink, and
    where the law itself is no faster than explicit steps can follow.
    """
    errors = [0.0]
    for per_step in PER_STEP:
        tank = Drained(kind, per_step, smoothing)
        datum = tank.component.datum
        for level in torch.linspace(datum, HEIGHT, 100, dtype=torch.float64).tolist()[1:]:
            sharp = tank.outflow(level, 1e-12)
            if sharp * tank.step / AREA <= level - datum and tank.slope(level) * tank.step / AREA <= FASTEST:
                errors.append(abs(tank.outflow(level, tank.resolution) / sharp - 1.0))
    return worst(errors)


def settles(kind: type[FlowComponent], smoothing: float = 1.0) -> bool:
    """Whether all levels become steady at that of the law, in units of the inflow's rise within one step."""
    for per_step in LONG:
        tank = Drained(kind, per_step, smoothing)
        for share in SHARES:
            inflow = share * tank.full
            rise = inflow * tank.step / AREA
            levels = tank.levels(inflow)
            error = abs(float(levels[-1]) - tank.level_of(inflow)) / rise
            change = float((levels[-20:] - levels[-1]).abs().max()) / rise
            if not (error < 1.0 and change < 1e-3):  # also if they are no numbers
                return False
    return True


def worst(errors: list[float]) -> float:
    """The greatest error; infinite where steps have grown beyond all numbers, which `max` would pass over."""
    return max(math.inf if math.isnan(error) else error for error in errors)


@draining
def test_the_law_is_smoothed_no_further_than_one_step_from_its_kink(kind: type[FlowComponent]) -> None:
    assert smoothing_error(kind) < 0.05


@draining
def test_long_steps_settle_at_the_level_of_the_law(kind: type[FlowComponent]) -> None:
    assert settles(kind)


@draining
def test_a_wrong_smoothing_fails_these_tests(kind: type[FlowComponent]) -> None:
    """Of steps ten times longer, and of steps ten times shorter, than those taken."""
    assert smoothing_error(kind, 10.0) > 0.05
    assert not settles(kind, 0.1)


def first_own_constant(plant: PlantDescription, kind: type[FlowComponent]) -> str:
    """The first constant of X that can be estimated and changes the readings."""
    network = build_network(plant)
    names = [f"X.{name}" for name, _, role in kind.example("X", "A", "B").constants() if role == "estimated"]
    space = ParameterSpace(network.constants[name] for name in names)
    engine = ReferenceEngine(network, space, lay_out(inputs_of(plant), plant.channels(), SAMPLE))
    moved = engine.readings(
        torch.stack([space.nominal(), *(space.nominal() * (1 + d) for d in 0.1 * torch.eye(len(names)))])
    )
    return next(n for n, reading in zip(names, moved[1:], strict=True) if (reading - moved[0]).abs().max() > 1e-4)


@kinds
def test_training_recovers_one_of_its_constants(kind: type[FlowComponent], here: Path) -> None:
    """From readings with a noise of 1 mm, to within four standard errors."""
    plant = plant_with(kind)
    name = first_own_constant(plant, kind)
    space = ParameterSpace([build_network(plant).constants[name]])
    true = 0.9 * space.nominal()
    recording = inputs_of(plant)
    readings = ReferenceEngine(build_network(plant), space, lay_out(recording, plant.channels(), SAMPLE)).readings(true)
    noise = 1e-3 * torch.randn(readings.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    recording = replace(recording, outputs=readings + noise, mask=None)
    run = {
        "plant": plant,
        "recordings": [recording],
        "estimate": {"parameters": [name], "search": {"evaluations": 600, "population": 20}},
    }
    estimate = fdi_torch.train(run).result.estimate
    assert abs(float(estimate.value[0] - true)) < 4.0 * float(estimate.std[0])
    assert float(estimate.std[0]) < 0.05 * float(true)


engines = pytest.mark.parametrize("engine", ["compiled", "traced"])


@kinds
@engines
def test_every_engine_gives_the_same_readings_and_slopes(kind: type[FlowComponent], engine: str) -> None:
    plant = plant_with(kind)
    network = build_network(plant)
    names = [f"X.{n}" for n, _, _ in kind.example("X", "A", "B").constants()]
    space = ParameterSpace(network.constants[name] for name in names)
    experiment = lay_out(inputs_of(plant), plant.channels(), SAMPLE)
    theta = torch.stack([space.nominal(), 1.05 * space.nominal()])
    try:
        readings, slopes = make_engine(network, space, experiment, engine).linearise(theta)
    except BuildError as error:
        pytest.skip(str(error))
    expected, expected_slopes = ReferenceEngine(network, space, experiment).linearise(theta)
    assert torch.allclose(readings, expected, rtol=0.0, atol=1e-10)
    assert torch.allclose(slopes, expected_slopes, rtol=1e-6, atol=1e-9 * float(expected_slopes.abs().max()))


@kinds
@pytest.mark.parametrize("engine", [CompiledEngine, OwnStepsEngine])
def test_adaptive_steps_keep_their_tolerance(kind: type[FlowComponent], engine: type[Engine]) -> None:
    """A tenth of a millimetre, against steps of a quarter of a second."""
    plant = plant_with(kind)
    control = StepControl.for_tolerance(1e-4, plant)
    experiment = lay_out(inputs_of(plant), plant.channels(), SAMPLE, control)
    network = build_network(plant)
    try:
        levels = engine(network, ParameterSpace(), experiment).levels(network.nominal.new_zeros(0))
    except BuildError as error:
        pytest.skip(str(error))
    assert (levels - levels_of(kind, 0.25)).abs().max() < 1e-4


@kinds
@pytest.mark.parametrize(("metre", "second"), [(3.7, 1.0), (1.0, 0.23)])
def test_its_units_are_true(kind: type[FlowComponent], metre: float, second: float) -> None:
    """A plant in other metres and seconds has the same levels, but for the unit."""
    plant = plant_with(kind)
    other = rescaled(plant, metre, second)
    recording = inputs_of(plant)
    channels = torch.tensor([factor(u, metre, second) for u in plant.channel_units().values()], dtype=torch.float64)
    recording = replace(recording, time=second * recording.time, inputs=recording.inputs * channels)
    network = build_network(other)
    engine = ReferenceEngine(network, ParameterSpace(), lay_out(recording, other.channels(), SAMPLE * second))
    levels = engine.levels(network.nominal.new_zeros(0)) / metre
    assert torch.allclose(levels, levels_of(kind), rtol=1e-6, atol=1e-9)


def test_weirs_in_a_row_are_computed_along_the_water() -> None:
    """Whatever their order in the file; a circle of transfers is cut."""
    tanks = tuple(Tank(name, AREA, HEIGHT) for name in "ABC")
    weirs = (Weir("second", "B", "C", 0.3, 0.02), Weir("first", "A", "B", 0.3, 0.02))
    circle = (Transfer("X", "C", "A", 1e-5), Transfer("Y", "A", "C", 1e-5))
    plant = PlantDescription("row", tanks, weirs=weirs, transfers=circle)
    names = [component.name for component in plant.flows_in_order]
    assert names.index("first") < names.index("second")
    assert sorted(names) == ["X", "Y", "first", "second"]


def test_an_argument_that_is_no_kind_is_named() -> None:
    with pytest.raises(TypeError, match="weirs"):
        fdi_torch.Plant([Tank("A", AREA, HEIGHT)], sensors=[Sensor("a", "A")], weir=[])


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ("{source: A, target: A, crest: 10 cm, width: 2 cm}", "weirs.W: expected two different ends, got A twice"),
        ("{source: B, crest: 10 cm, width: 2 cm}", "weirs.W.source: expected one of the tanks A, got 'B'"),
        ("{source: A, crest: 10 cm, width: 0 cm}", "weirs.W.width: expected a positive number, got 0 cm"),
        ("{source: A, crest: 10 cm, width: 2 cm, discharge_coefficient: 60}", "weirs.W.discharge_coefficient"),
        ("{source: A, width: 2 cm}", "weirs.W.crest"),
    ],
)
def test_a_wrong_weir_is_named_with_its_key(keys: str, problem: str) -> None:
    text = f"tanks: {{A: {{area: 150 cm^2, height: 50 cm}}}}\nsensors: {{a: {{tank: A}}}}\nweirs: {{W: {keys}}}\n"
    with pytest.raises(ConfigError, match=re.escape(problem)):
        build_plant(parse_yaml(text.encode(), "plant"), "plant")


@kinds
def test_gap_names_its_most_usual_fault(kind: type[FlowComponent], tmp_path: Path) -> None:
    """Among the usual faults of everything in the plant and leaks; a fault of 20 % of the flow."""
    plant = plant_with(kind)
    effect, size = kind.usual_faults[0].split(".")
    network = build_network(plant, [place(effect, "X")])
    nominal = network.constants[f"X.{effect}.{size}"].nominal
    space = ParameterSpace([network.constants[f"X.{effect}.{size}"]])
    recording = inputs_of(plant)
    engine = ReferenceEngine(network, space, lay_out(recording, plant.channels(), 0.05 * SAMPLE))
    readings = engine.readings(torch.tensor([nominal - 0.2 if nominal else 0.2], dtype=torch.float64))
    noise = 5e-4 * torch.randn(readings.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    recording = replace(recording, outputs=readings + noise, mask=None)
    found = fdi_torch.gap(plant, recording, out=tmp_path, library=("plugging", "pump_gain", "leak"))
    assert [(c.effect, c.location) for c in found.answer.causes] == [(effect, "X")]
