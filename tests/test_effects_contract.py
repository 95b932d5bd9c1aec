"""Contract tests of every effect at every place of three plants; authors of effects need not write them.

What simulates an effect by itself is tested at one place of each kind of component.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import pytest
import torch
from rigs import blank_recording, factor, rescaled, three_tank
from torch import Tensor

from fdi_torch.effects import EFFECTS, all_placements, build_network, effect
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import FLOW_KINDS, OUTSIDE, Pipe, PlacedEffect, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Placement, Stage
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.operating_range import OperatingRange, operating_range_of
from fdi_torch.plant.signals import Clock
from fdi_torch.recording import Recording
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.engine_choice import make_engine
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.traced_engine import TracedEngine

SAMPLES, SAMPLE = 24, 5.0  # s


def valve_plant() -> PlantDescription:
    """Two tanks with valves, one before an outlet; volts in and out; B catches what A spills."""
    return PlantDescription(
        "valves",
        (Tank("A", 0.015, 0.9, 0.25, overflow_to="B"), Tank("B", 0.012, 0.5, 0.15)),
        (
            Pipe("AB", "A", "B", 0.5e-4, 0.6, valve="vAB"),
            Pipe("OUT", "B", "outside", 0.6e-4, 0.6, elevation=0.01, valve="vOUT"),
        ),
        (Pump("P", "A", 1e-4, 1e-5, "u", "m^3/s/V"),),
        (Sensor("yA", "A", "V", 20.0, 0.3), Sensor("yB", "B", "V", -15.0, 9.0)),
    )


def plant_of_every_kind() -> PlantDescription:
    """Two tanks joined by every kind of flow component, that starts above the crest of a weir."""
    tanks = (Tank("A", 0.015, 0.5, 0.28), Tank("B", 0.012, 0.5, 0.25))
    pairs = (Sensor("a", "A"), Sensor("b", "B"))
    flows: dict[str, Any] = {
        kind.part(): (kind.example(kind.__name__, "A", "B"), kind.example(f"{kind.__name__}2", "B", "outside"))
        for kind in FLOW_KINDS
    }
    return PlantDescription("every kind", tanks, sensors=pairs, **flows)


PLANTS = {"three_tank": three_tank((0.3, 0.25, 0.28)), "valves": valve_plant(), "every kind": plant_of_every_kind()}


def placements_of(plant: PlantDescription) -> tuple[Placement, ...]:
    """The whole library at all places; of the plant of every kind only what its kinds accept beyond the others."""
    everything = all_placements(plant)
    if plant.name != "every kind":
        return everything
    accepted = {c.name: c.accepts for c in plant.flow_components()}
    return tuple(p for p in everything if p.effect.name in accepted.get(p.location, ()))


def one_of_each_kind(plant: PlantDescription) -> tuple[Placement, ...]:
    """Of the places of an effect whose components are of one kind, and lead outside or not, the last one."""
    components = {c.name: c for c in plant.components()}
    chosen: dict[tuple[object, ...], Placement] = {}
    for placement in placements_of(plant):
        component = components.get(placement.location)
        leads_outside = getattr(component, "target", None) == OUTSIDE
        chosen[placement.effect.name, type(component), leads_outside] = placement
    return tuple(chosen.values())


PLACES = [(name, p.prefix) for name, plant in PLANTS.items() for p in placements_of(plant)]
everywhere = pytest.mark.parametrize(("plant", "place"), PLACES)
EACH_KIND = [(name, p.prefix) for name, plant in PLANTS.items() for p in one_of_each_kind(plant)]
at_each_kind = pytest.mark.parametrize(("plant", "place"), EACH_KIND)


def random_inputs(plant: PlantDescription) -> Recording:
    """Each channel steps every 20 s between a fifth and nine tenths of its full scale; the pumps begin at rest."""
    generator = torch.Generator().manual_seed(7)
    full = {c.channel: c.full_command for c in plant.metered_flows()}
    scale = torch.tensor([full.get(c, 1.0) for c in plant.channels()], dtype=torch.float64)
    steps = 0.2 + 0.7 * torch.rand(SAMPLES // 4 + 1, len(scale), generator=generator, dtype=torch.float64)
    time = torch.arange(SAMPLES, dtype=torch.float64) * SAMPLE
    for channel in full:
        steps[0, plant.channels().index(channel)] = 0.0
    return blank_recording(plant, scale * steps.repeat_interleave(4, dim=0)[:SAMPLES], time)


@dataclass(frozen=True)
class Rig:
    """A plant with some effects, all of whose parameters are free, and the reference experiment on it."""

    plant: PlantDescription
    network: TankNetwork
    space: ParameterSpace
    engine: ReferenceEngine

    def placement(self, prefix: str) -> Placement:
        return next(p for p in self.network.placements if p.prefix == prefix)

    def size(self, prefix: str) -> str:
        placement = self.placement(prefix)
        return f"{prefix}.{placement.effect.parameters(placement.location, self.plant)[0].name}"

    def starts(self, prefix: str) -> list[dict[str, float]]:
        placement = self.placement(prefix)
        named = placement.effect.starts(placement.location, self.plant, bare_reach(self.plant.name))
        return [{f"{prefix}.{name}": value for name, value in start.items()} for start in named]


def rig_of(plant: PlantDescription, placements: tuple[Placement, ...]) -> Rig:
    network = build_network(plant, placements)
    prefixes = {p.prefix for p in network.placements}
    space = ParameterSpace(p for p in network.constants if p.name.rpartition(".")[0] in prefixes)
    engine = ReferenceEngine(network, space, lay_out(random_inputs(plant), plant.channels(), SAMPLE))
    return Rig(plant, network, space, engine)


def experiment_on(plant: PlantDescription) -> Tensor:
    """Readings (S, sensors) of the plant as its description has it."""
    r = rig_of(plant, ())
    return r.engine.readings(r.space.nominal())


@cache
def rig(plant: str) -> Rig:
    """The plant with the whole library at all its places."""
    return rig_of(PLANTS[plant], placements_of(PLANTS[plant]))


@dataclass(frozen=True)
class Alone:
    """Readings of a plant with one effect. started: at its last start, by itself and in a batch beside a lane of NaN.

    nominal, shaped: in the same batch, at nominal and with the start's shape but a size at nominal.
    """

    rig: Rig
    started: Tensor
    started_in_batch: Tensor
    nominal: Tensor
    shaped: Tensor


@cache
def alone(plant: str, prefix: str) -> Alone:
    r = rig_of(PLANTS[plant], (rig(plant).placement(prefix),))
    starts = rig(plant).starts(prefix)
    start, nominal = r.space.vector(starts[-1]), r.space.nominal()
    shape = r.space.vector({n: v for one in starts for n, v in one.items() if n != r.size(prefix)})
    batch = r.engine.readings(torch.stack([torch.full_like(start, math.nan), start, nominal, shape]))
    return Alone(r, r.engine.readings(start), batch[1], batch[2], batch[3])


@cache
def first_starts(plant: str) -> dict[str, Tensor]:
    """Readings at the start, of each effect's own ones, that shows most; computed in one batch with a NaN neighbour."""
    r = rig(plant)
    lanes = [(p.prefix, start) for p in r.network.placements for start in r.starts(p.prefix)]
    thetas = torch.stack([*(r.space.vector(start) for _, start in lanes), torch.full((len(r.space),), math.nan)])
    readings = r.engine.readings(thetas)
    assert bool(torch.isnan(readings[-1]).any())
    best: dict[str, Tensor] = {}
    for (prefix, _), reading in zip(lanes, readings, strict=False):
        shown = best.get(prefix, bare_reading(plant))
        if bool((reading - bare_reading(plant)).abs().max() >= (shown - bare_reading(plant)).abs().max()):
            best[prefix] = reading
    return best


@cache
def slopes(plant: str) -> Tensor:
    """d reading / d parameter at nominal, (S, sensors, P), in forward mode."""
    r = rig(plant)
    return traced(r).linearise(r.space.nominal())[1]


def traced(r: Rig) -> TracedEngine:
    """Forward derivatives of the same equations, at a fraction of the time."""
    return TracedEngine(r.network, r.space, r.engine.experiment)


@cache
def compiled_starts(plant: str) -> tuple[Tensor, Tensor]:
    """Readings at every effect's last start by the compiled engine and by the reference engine, (N, S, sensors)."""
    r = rig(plant)
    thetas = torch.stack([r.space.vector(r.starts(p.prefix)[-1]) for p in r.network.placements])
    engine = make_engine(r.network, r.space, r.engine.experiment, "compiled")
    return engine.readings(thetas), r.engine.readings(thetas)


@cache
def bare_reading(plant: str) -> Tensor:
    """Readings of the plant without any effect."""
    return experiment_on(PLANTS[plant])


@cache
def bare_reach(plant: str) -> OperatingRange:
    recording = replace(random_inputs(PLANTS[plant]), outputs=bare_reading(plant), mask=None)
    return operating_range_of(recording, PLANTS[plant])


@at_each_kind
def test_neutral_at_nominal_bit_for_bit(plant: str, place: str) -> None:
    assert torch.equal(alone(plant, place).nominal, bare_reading(plant))


@pytest.mark.parametrize("plant", PLANTS)
def test_the_whole_library_at_nominal_changes_no_bit(plant: str) -> None:
    r = rig(plant)
    assert torch.equal(r.engine.readings(r.space.nominal()), bare_reading(plant))


@at_each_kind
def test_nothing_there_while_the_size_is_nominal_whatever_the_shape(plant: str, place: str) -> None:
    assert torch.equal(alone(plant, place).shaped, bare_reading(plant))


@everywhere
def test_starts_lie_in_the_box_and_one_of_them_shows(plant: str, place: str) -> None:
    r = rig(plant)
    for start in r.starts(place):
        assert r.size(place) in start
        for name, value in start.items():
            assert r.space[name].low <= value <= r.space[name].high, name
    shown = (first_starts(plant)[place] - bare_reading(plant)).abs().max()
    assert shown > 0 or r.placement(place).effect.quantizes
    assert bool(torch.isfinite(first_starts(plant)[place]).all())


@everywhere
def test_its_instants_are_times_with_several_starts(plant: str, place: str) -> None:
    r, placement = rig(plant), rig(plant).placement(place)
    times = [placement.full_name(name) for name in placement.effect.instants]
    assert all(r.space[name].unit == "s" for name in times)
    grid = {tuple(start[name] for name in times) for start in r.starts(place) if start.keys() >= set(times)}
    assert not times or len(grid) > 1


@at_each_kind
def test_alone_equals_in_batch_beside_a_lane_of_nan(plant: str, place: str) -> None:
    assert torch.equal(alone(plant, place).started_in_batch, alone(plant, place).started)


@everywhere
def test_slope_of_the_size_is_finite_and_shows_where_the_effect_is_smooth(plant: str, place: str) -> None:
    r = rig(plant)
    slope = slopes(plant)[..., r.space.index(r.size(place))]
    assert bool(torch.isfinite(slope).all())
    if r.placement(place).effect.smooth:
        assert slope.abs().max() > 0
        assert torch.allclose(slope, one_sided_slopes(plant)[place], atol=1e-2 * float(slope.abs().max()))
    else:
        assert slope.abs().max() == 0, "it is smooth after all"


@cache
def one_sided_slopes(plant: str) -> dict[str, Tensor]:
    """From readings with sizes just inside the box: a second opinion on the Jacobian."""
    r = rig(plant)
    sizes = [r.space[r.size(p.prefix)] for p in r.network.placements]
    steps = [1e-5 * ((z.high if z.high > z.nominal else z.low) - z.nominal) for z in sizes]
    lanes = [r.space.vector({z.name: z.nominal + step}) for z, step in zip(sizes, steps, strict=True)]
    changes = r.engine.readings(torch.stack(lanes)) - bare_reading(plant)
    return {p.prefix: c / step for p, c, step in zip(r.network.placements, changes, steps, strict=True)}


@pytest.mark.parametrize("plant", PLANTS)
def test_slopes_of_shapes_are_finite_at_starts(plant: str) -> None:
    r = rig(plant)
    theta = r.space.vector({n: v for p in r.network.placements for n, v in r.starts(p.prefix)[0].items()})
    assert bool(torch.isfinite(traced(r).linearise(theta)[1]).all())


@everywhere
def test_the_compiled_engine_gives_the_same_numbers(plant: str, place: str) -> None:
    try:
        compiled, reference = compiled_starts(plant)
    except BuildError as error:
        pytest.skip(str(error))
    lane = [p.prefix for p in rig(plant).network.placements].index(place)
    assert torch.allclose(compiled[lane], reference[lane], rtol=0.0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["valves", "every kind"])
def test_the_compiled_engine_gives_the_same_slopes(plant: str) -> None:
    """Of the three tanks with every effect, test_engines compares them."""
    r = rig_of(PLANTS[plant], one_of_each_kind(PLANTS[plant]))
    try:
        engine = make_engine(r.network, r.space, r.engine.experiment, "compiled")
    except BuildError as error:
        pytest.skip(str(error))
    expected = traced(r).linearise(r.space.nominal())[1]
    assert torch.allclose(engine.linearise(r.space.nominal())[1], expected, rtol=1e-9, atol=1e-9)


@cache
def rescaled_readings(plant: str, m: float, s: float) -> dict[str, Tensor]:
    """Readings of every effect's last start on the rescaled plant, brought back to the first units."""
    r = rig(plant)
    other = rescaled(r.plant, m, s)
    network = build_network(other, placements_of(other))
    space = ParameterSpace(network.constants[name] for name in r.space.names)
    recording = random_inputs(r.plant)
    channels = torch.tensor([factor(u, m, s) for u in other.channel_units().values()], dtype=torch.float64)
    recording = replace(recording, time=recording.time * s, inputs=recording.inputs * channels)
    engine = ReferenceEngine(network, space, lay_out(recording, other.channels(), SAMPLE * s))
    scale = torch.tensor([factor(p.unit, m, s) for p in r.space], dtype=torch.float64)
    thetas = torch.stack([r.space.vector(r.starts(p.prefix)[-1]) * scale for p in r.network.placements])
    back = torch.tensor([factor(y.unit, m, s) for y in other.sensors], dtype=torch.float64)
    return dict(zip((p.prefix for p in r.network.placements), engine.readings(thetas) / back, strict=True))


@at_each_kind
def test_declared_units_are_true(plant: str, place: str) -> None:
    for metre, second in ((100.0, 1.0), (1.0, 60.0)):
        assert torch.allclose(rescaled_readings(plant, metre, second)[place], alone(plant, place).started, rtol=1e-5)


EQUIVALENT = [
    (name, p.prefix)
    for name, plant in PLANTS.items()
    for p in placements_of(plant)
    if p.effect.equivalents(p.location, plant, {})
]


@pytest.mark.parametrize(("plant", "place"), EQUIVALENT)
def test_equivalent_effects_name_each_other_and_read_the_same(plant: str, place: str) -> None:
    placement = rig(plant).placement(place)
    for start in placement.effect.starts(placement.location, PLANTS[plant], bare_reach(plant)):
        own = rig_of(PLANTS[plant], (replace(placement, values=start),))
        for (name, at), values in placement.effect.equivalents(placement.location, PLANTS[plant], start).items():
            back = effect(name).equivalents(at, PLANTS[plant], values)[placement.cause]
            assert {n: back.get(n) for n in start} == pytest.approx(start)
            other = rig_of(PLANTS[plant], (Placement(effect(name), at, values),))
            readings = [r.engine.readings(r.space.nominal()) for r in (own, other)]
            assert torch.allclose(*readings, rtol=0.0, atol=1e-9)


SPILLING = replace(three_tank(), tanks=(replace(three_tank().tanks[0], overflow_to="T2"), *three_tank().tanks[1:]))
BALANCED = [
    pytest.param(plant, p, id=f"{plant.name}-{p.prefix}")
    for plant in (PLANTS["valves"], SPILLING)
    for p in all_placements(plant)
    if p.effect.stage is Stage.BALANCE
]


@pytest.mark.parametrize(("plant", "placement"), BALANCED)
def test_what_a_tank_loses_arrives_in_others_or_leaves_the_plant(plant: PlantDescription, placement: Placement) -> None:
    """At each of its starts, and with all other parameters at their upper bound; its own states below the steady ones,
    in which a chamber beside a tank exchanges nothing.
    """
    network = build_network(plant, (placement,))
    levels = {t.name: (0.5 * t.height, 0.95 * t.height) for t in plant.tanks}
    starts = placement.effect.starts(placement.location, plant, OperatingRange(1000.0, {}, {}, levels))
    space = ParameterSpace(p for p in network.constants if p.name.startswith(f"{placement.prefix}."))
    nominal, *begun = (space.vector({placement.full_name(n): v for n, v in s.items()}) for s in ({}, *starts))
    extreme = [torch.where((start == nominal) & space.high().isfinite(), space.high(), start) for start in begun]
    theta = torch.stack([nominal, *begun, *extreme])
    levels_now = [theta.new_full((len(theta),), (0.9 - 0.1 * k) * t.height) for k, t in enumerate(plant.tanks)]
    end = theta.new_tensor(500.0)
    clock, values = Clock(end - 1.0, end, end / end), network.bind(space, theta)
    commands = [theta.new_zeros(len(theta)) for _ in network.actuators()]
    steady = network.with_steady_states(levels_now, commands, clock, values)
    state = [*levels_now, *(0.5 * own for own in steady[len(levels_now) :])]
    point = network.operating_point(state, commands, clock, values)
    net = torch.stack(network.less_overflow(point, network.net_inflows(point, network.flows(point))))
    change = dict(zip((t.name for t in plant.tanks), net - net[:, :1], strict=True))
    first, *_ = plant.tanks_at(placement.location)
    lost, arrived = -change.pop(first), sum(change.values())
    size, rounding = lost.abs(), 1e-12 * net.abs().max()
    assert bool((size > rounding).any())
    assert bool((arrived * lost.sign() >= -rounding).all()) and bool((arrived.abs() <= size + rounding).all())
    if len(plant.tanks_at(placement.location)) == 2:
        assert torch.allclose(arrived, lost, rtol=0.0, atol=float(rounding))


@at_each_kind
def test_a_plant_file_can_have_it(plant: str, place: str) -> None:
    """As part of the plant's description, with these parameters, it does the same as beside it."""
    location, name = place.split(".")
    own = {full.rpartition(".")[2]: value for full, value in rig(plant).starts(place)[-1].items()}
    described = replace(PLANTS[plant], effects=(PlacedEffect(name, location, own),))
    assert torch.equal(experiment_on(described), alone(plant, place).started)


def test_names_are_unique_and_twins_are_known() -> None:
    names = [e.name for e in EFFECTS]
    assert len(set(names)) == len(names)
    for e in EFFECTS:
        assert e.mistaken_for, f"{e.name} says nothing of what it is mistaken for"
        for other in e.mistaken_for:
            assert other != e.name and effect(other).name == other
