"""`Plant`: a rig as Python code or a plant file describes it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from fnmatch import fnmatchcase
from typing import Any

import torch
from torch import Tensor

from fdi_torch.config.strict import quantity
from fdi_torch.effects import build_network, effect, placements_for
from fdi_torch.names import matching, unknown
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.description import FaultPriority, Pipe, PlacedEffect, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Effect, fits, place_kind
from fdi_torch.simulate.ode import Inputs, PlantOde

Read = Callable[[Any, str], float]
"""From a value as written and its SI unit to its SI value."""


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Plant(PlantDescription):
    """A rig: its components, what is known of their constants, and the effects that it is known to have.

    Quantities are text with a unit, as in a plant file ('200 cm^2', '3 %'), or numbers in SI. tolerances: one standard
    deviation of a constant as a share of it, by patterns such as '*.discharge_coefficient' (* is any name); of an
    offset, a start level or a parameter of an effect in its unit. varying: patterns of the constants that are others in
    each recording. effects: what the plant is known to have. matters: which faults a monitor says aloud, in SI.

    `dump_plant` writes it as a plant file, from which `load_plant` makes an equal one. Raises ValueError naming
    component and field, what is expected there and what is given.

    >>> Plant(
    ...     tanks=[Tank("A", area="200 cm^2", height="60 cm")],
    ...     pipes=[Pipe("drain", "A", "outside", area="0.5 cm^2", discharge_coefficient=0.6)],
    ...     pumps=[Pump("Q", "A", max_flow="6 l/min")],
    ...     sensors=[Sensor("h", "A")],
    ...     tolerances={"*.discharge_coefficient": "3 %"},
    ... ).channels()
    ('Q',)
    """

    def __init__(
        self,
        tanks: Iterable[Tank],
        pipes: Iterable[Pipe] = (),
        pumps: Iterable[Pump] = (),
        sensors: Iterable[Sensor] = (),
        *,
        effects: Iterable[PlacedEffect] = (),
        tolerances: Mapping[str, float | str] | None = None,
        varying: Iterable[str] = (),
        gravity: float | str = 9.81,
        matters: Iterable[FaultPriority] = (),
        name: str = "plant",
    ) -> None:
        parts = (tuple(tanks), tuple(pipes), tuple(pumps), tuple(sensors))
        bare = PlantDescription(name, *parts, gravity=settled("gravity", gravity, "m/s^2"))
        if not bare.sensors:
            raise ValueError("sensors: expected at least one, got none; add one such as h1: {tank: T1}")
        placed = tuple(settled_effect(i, each, bare) for i, each in enumerate(effects))
        own = PlantDescription(name, *parts, placed, gravity=bare.gravity)
        given = settled_tolerances(tolerances or {}, own)
        super().__init__(name, *parts, placed, given, _varying(varying, given), tuple(matters), bare.gravity)

    def __eq__(self, other: object) -> bool:
        """A plant equals any description of the same."""
        if not isinstance(other, PlantDescription):
            return NotImplemented
        return all(getattr(self, f.name) == getattr(other, f.name) for f in fields(PlantDescription))

    __hash__ = None  # type: ignore[assignment]

    def ode(
        self,
        inputs: Inputs,
        theta: Mapping[str, float | Tensor] | None = None,
        *,
        resolution: float | None = None,
    ) -> PlantOde:
        """dh/dt = f(t, h) of this plant, as `torchdiffeq.odeint` takes it; `.start` are the start levels.

        inputs: a `Recording`, constant inputs (channels,) in SI, or a function of t in s to these. theta: parameters
        that differ from their nominal values, by full name in SI, each a number or a tensor (*batch), through which
        gradients flow: {"A.leak.size": size}. resolution: s, how sharply roots and rims are drawn.
        Raises ValueError for a name that is no parameter, and for actuators with memory or delay.
        """
        named = theta or {}
        network = build_network(self, placements_for(named))
        space = ParameterSpace(network.constants[name] for name in named)
        columns = torch.broadcast_tensors(*(torch.as_tensor(v, dtype=torch.float64) for v in named.values()))
        return PlantOde(network, inputs, space, torch.stack(columns, -1) if columns else None, resolution=resolution)

    def _repr_html_(self) -> str:
        """The drawing of the rig, in a notebook."""
        from fdi_torch.report.schematic import schematic
        from fdi_torch.report.style import inline_svg

        return str(inline_svg(schematic(self), f"plant-{self.name}", f"plant {self.name}"))


def settled(place: str, value: float | str, unit: str, read: Read | None = None) -> float:
    """A quantity in SI: text by its unit, a number as it is; or by `read`. Raises ValueError naming `place`."""
    try:
        if read is None:
            return quantity(value, unit) if isinstance(value, str) else quantity(value, "1")
        return read(value, unit)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def settled_effect(index: int, placed: PlacedEffect, plant: PlantDescription, read: Read | None = None) -> PlacedEffect:
    """The effect with its parameters in SI. Raises ValueError where it cannot be there, or has no such parameter."""
    place = f"effects.{index}"
    try:
        known = effect_parameters(placed.effect, placed.location, plant)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error
    for name in placed.parameters:
        if name not in known:
            raise ValueError(f"{place}.parameters: {unknown(f'a parameter of {placed.effect}', name, known)}")
    values = {n: settled(f"{place}.parameters.{n}", v, known[n].unit, read) for n, v in placed.parameters.items()}
    for name, value in values.items():
        if value < 0.0 <= known[name].low:
            raise ValueError(f"{place}.parameters.{name}: expected at least 0 {known[name].unit}, got {value:g}")
    return PlacedEffect(placed.effect, placed.location, values)


def effect_parameters(name: str, location: str, plant: PlantDescription) -> dict[str, Parameter]:
    """The parameters of an effect at a place, by their short names. Raises ValueError where it cannot be there."""
    return {p.name: p for p in effect_at(name, location, plant).parameters(location, plant)}


def effect_at(name: str, location: str, plant: PlantDescription) -> Effect:
    """The effect of that name. Raises ValueError where it cannot be at that place of the plant."""
    found = effect(name)
    if not fits(found, plant, location):
        there = ", ".join(place for place in plant.locations() if fits(found, plant, place)) or "none there is"
        raise ValueError(
            f"{location}.{name}: expected a place of kind {' or '.join(found.places)} ({there}), "
            f"got {place_kind(plant, location)} {location}"
        )
    return found


def settled_tolerances(
    patterns: Mapping[str, float | str], plant: PlantDescription, read: Read | None = None
) -> dict[str, float]:
    """Patterns such as *.discharge_coefficient spelled out for every constant that they match, in SI; later ones win.

    A pattern for parameters of effects has two dots.
    """
    units = absolute_units(plant)
    known = [*_constants(plant), *effect_units(plant)]
    tolerances: dict[str, float] = {}
    for pattern, value in patterns.items():
        place = f"tolerances.{pattern}"
        matched = [n for n in known if fnmatchcase(n, pattern) and n.count(".") == max(pattern.count("."), 1)]
        if not matched:
            raise ValueError(f"{place}: {unknown('a constant', pattern, known)}")
        for name in matched:
            tolerances[name] = settled(place, value, units.get(name, "1"), read)
            if not tolerances[name] > 0:
                raise ValueError(f"{place}: expected a positive tolerance such as 3 %, got {value}")
    return tolerances


def _varying(patterns: Iterable[str], tolerances: dict[str, float]) -> tuple[str, ...]:
    """Raises ValueError for what matches no constant with a tolerance: how much would it vary?"""
    try:
        return tuple(matching("a constant with a tolerance", patterns, tolerances))
    except ValueError as error:
        raise ValueError(f"varying: {error}") from error


def absolute_units(plant: PlantDescription) -> dict[str, str]:
    """Tolerances that are no shares: of offsets, start levels and the parameters of effects, with their units."""
    offsets = {f"{sensor.name}.offset": sensor.unit for sensor in plant.sensors}
    return offsets | {f"{tank.name}.start_level": "m" for tank in plant.tanks} | effect_units(plant)


def effect_units(plant: PlantDescription) -> dict[str, str]:
    """Units of all parameters of the plant's effects, by their full names."""
    return {
        f"{e.location}.{e.effect}.{name}": parameter.unit
        for e in plant.effects
        for name, parameter in effect_parameters(e.effect, e.location, plant).items()
    }


def _constants(plant: PlantDescription) -> list[str]:
    kinds: Sequence[tuple[Sequence[Any], tuple[str, ...]]] = (
        (plant.tanks, ("area", "height", "start_level")),
        (plant.pipes, ("area", "discharge_coefficient")),
        (plant.pumps, ("gain", "max_flow")),
        (plant.sensors, ("gain", "offset")),
    )
    return [f"{each.name}.{field}" for components, names in kinds for each in components for field in names]
