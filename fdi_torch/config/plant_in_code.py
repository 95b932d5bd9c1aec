"""`Plant`: a rig as described in Python code or in a plant file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from fdi_torch.config.problems import naming
from fdi_torch.config.strict import quantity
from fdi_torch.config.written_units import written_units
from fdi_torch.effects import build_network, effect_at, full_name, placements_for
from fdi_torch.names import matching, unknown
from fdi_torch.parameters import Parameter, ParameterSpace, is_effect_parameter
from fdi_torch.plant.description import (
    FLOW_KINDS,
    FaultPriority,
    Pipe,
    PlacedEffect,
    PlantDescription,
    Pump,
    Sensor,
    Tank,
)
from fdi_torch.plant.flow_component import FlowComponent
from fdi_torch.plant.scales import tank_table
from fdi_torch.quantities import displayed_in

if TYPE_CHECKING:
    from fdi_torch.simulate.ode import Inputs, PlantOde

Component = TypeVar("Component")
Read = Callable[[Any, str], float]
"""A function from a value as written and its SI unit to its SI value."""


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Plant(PlantDescription):
    """A rig: its components, prior knowledge of their constants, and its known effects.

    Quantities are text with a unit, as in a plant file ('200 cm^2', '3 %'), or numbers in SI. tolerances: relative
    standard deviations of constants, by patterns such as '*.discharge_coefficient' (* is any name); of an offset, a
    start level or a parameter of an effect in its unit. varying: patterns of the constants that differ between
    recordings. effects: the plant's known effects. further: components of the other kinds of `FLOW_KINDS`, such as
    weirs=[Weir(...)] and transfers=[Transfer(...)]. matters: smallest reported size (SI) and urgency of faults for a
    monitor. units: units for display by SI unit or channel, such as {"m": "mm", "m^3/s": "l/min"}, in place of the
    written ones.

    `dump_plant` writes it as a plant file, which `load_plant` reads as an equal plant. Raises ValueError naming
    component and field, with the expected and the given value.

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
        units: Mapping[str, str] | None = None,
        name: str = "plant",
        **further: Iterable[FlowComponent],
    ) -> None:
        parts = (
            _listed("tanks", tanks, Tank),
            _listed("pipes", pipes, Pipe),
            _listed("pumps", pumps, Pump),
            _listed("sensors", sensors, Sensor),
        )
        flows = _further_flows(further)
        without_effects = PlantDescription(name, *parts, gravity=si_value("gravity", gravity, "m/s^2"), **flows)
        if not without_effects.sensors:
            raise ValueError("sensors: expected at least one, got none; add one such as h1: {tank: T1}")
        placed = tuple(effect_in_si(i, each, without_effects) for i, each in enumerate(effects))
        with_effects = PlantDescription(name, *parts, placed, gravity=without_effects.gravity, **flows)
        absolute_tolerances = tolerances_in_si(tolerances or {}, with_effects)
        with naming("varying"):
            varying = tuple(matching("a constant with a tolerance", varying, absolute_tolerances))
        super().__init__(
            name,
            *parts,
            placed,
            absolute_tolerances,
            varying,
            tuple(matters),
            without_effects.gravity,
            **flows,
            units=_units_as_written(with_effects) | dict(units or {}),
        )

    def __eq__(self, other: object) -> bool:
        """Equality of all fields with any `PlantDescription`."""
        if not isinstance(other, PlantDescription):
            return NotImplemented
        return all(getattr(self, f.name) == getattr(other, f.name) for f in fields(PlantDescription) if f.compare)

    __hash__ = None  # type: ignore[assignment]

    def ode(self, inputs: Inputs, theta: Mapping[str, float | torch.Tensor] | None = None) -> PlantOde:
        """dh/dt = f(t, h) of this plant, for `torchdiffeq.odeint`; `.start` is the state at which `simulate` starts.

        inputs: a `Recording`, constant inputs (channels,) in SI, or a function of t in s to these. theta: parameters
        that differ from their nominal values, by name in SI, each a number or a tensor (*batch), through which
        gradients flow: {"A.leak.size": size}; on their device, else on that of the inputs, the plant is computed.
        Raises ValueError for an unknown parameter, and for actuators with memory or dead time.
        """
        named = {full_name(name, self): value for name, value in (theta or {}).items()}
        from fdi_torch.simulate.ode import PlantOde

        network = build_network(self, placements_for(named))
        space = ParameterSpace(network.constants[name] for name in named)
        device = next((v.device for v in named.values() if isinstance(v, torch.Tensor)), None)
        values = (torch.as_tensor(v, dtype=torch.float64, device=device) for v in named.values())
        columns = torch.broadcast_tensors(*values)
        return PlantOde(network, inputs, space, torch.stack(columns, -1) if columns else None)

    def __str__(self) -> str:
        """The plant as a plant file."""
        from fdi_torch.config.plant_writer import dump_plant

        return dump_plant(self)

    def _repr_html_(self) -> str:
        """The drawing of the rig for notebooks, and the volume and emptying time of each tank."""
        from fdi_torch.report.schematic import schematic
        from fdi_torch.report.style import notebook_svg

        with displayed_in(self.units):
            return notebook_svg(schematic(self), f"plant-{self.name}", self.title) + tank_table(self).html()


def _listed(part: str, components: Iterable[Component], kind: type[Component]) -> tuple[Component, ...]:
    """The components of a part. Raises ValueError unless they are a list of that kind."""
    listed = tuple(components) if isinstance(components, Iterable) else None
    wrong = components if listed is None else next((each for each in listed if not isinstance(each, kind)), None)
    if listed is None or wrong is not None:
        example = f"[{kind.__name__}(...), ...]"
        raise ValueError(f"{part}: expected a list such as {example}, got a {type(wrong).__name__}")
    return listed


def _units_as_written(plant: PlantDescription) -> dict[str, str]:
    """Units for display, from the quantities of the components that were given as text."""
    listed = {"tanks": plant.tanks, "sensors": plant.sensors, "flows": plant.flow_components()}
    texts = {part: {c.name: c.written for c in components} for part, components in listed.items()}
    texts["flows"] |= {c.name: {**c.written, "command": c.channel} for c in plant.metered_flows()}
    return written_units(texts | {"sensors": {s.column: s.written for s in plant.sensors}})


def si_value(place: str, value: float | str, unit: str, read: Read | None = None) -> float:
    """The SI value of a text with a unit; a number is unchanged. Or by `read`. Raises ValueError naming `place`."""
    with naming(place):
        if read is None:
            return quantity(value, unit) if isinstance(value, str) else quantity(value, "1")
        return read(value, unit)


def effect_in_si(index: int, placed: PlacedEffect, plant: PlantDescription, read: Read | None = None) -> PlacedEffect:
    """The effect with its parameters in SI. Raises ValueError for an impossible place or an unknown parameter."""
    place = f"effects.{index}"
    with naming(place):
        known = effect_parameters(placed.effect, placed.location, plant)
    for name in placed.parameters:
        if name not in known:
            raise ValueError(f"{place}.parameters: {unknown(f'a parameter of {placed.effect}', name, known)}")
    values = {n: si_value(f"{place}.parameters.{n}", v, known[n].unit, read) for n, v in placed.parameters.items()}
    for name, value in values.items():
        if value < 0.0 <= known[name].low:
            raise ValueError(f"{place}.parameters.{name}: expected at least 0 {known[name].unit}, got {value:g}")
    return PlacedEffect(placed.effect, placed.location, values)


def effect_parameters(name: str, location: str, plant: PlantDescription) -> dict[str, Parameter]:
    """The parameters of an effect at a place, by short name. Raises ValueError for an impossible place."""
    return {p.name: p for p in effect_at(name, location, plant).parameters(location, plant)}


def tolerances_in_si(
    patterns: Mapping[str, float | str], plant: PlantDescription, read: Read | None = None
) -> dict[str, float]:
    """Expand patterns such as *.discharge_coefficient to every matching constant, in SI; later patterns override
    earlier ones.

    A pattern for parameters of effects has two dots.
    """
    units = absolute_units(plant)
    known = [*_constants(plant), *effect_units(plant)]
    tolerances: dict[str, float] = {}
    for pattern, value in patterns.items():
        place = f"tolerances.{pattern}"
        matched = [
            n for n in known if fnmatchcase(n, pattern) and is_effect_parameter(n) == is_effect_parameter(pattern)
        ]
        if not matched:
            raise ValueError(f"{place}: {unknown('a constant', pattern, known)}")
        for name in matched:
            tolerances[name] = si_value(place, value, units.get(name, "1"), read)
            if not tolerances[name] > 0:
                raise ValueError(f"{place}: expected a positive tolerance such as 3 %, got {value}")
            if name not in units and tolerances[name] > 1.0:
                raise ValueError(f"{place}: expected a share of {name} up to 100 %, such as 3 %, got {value}")
    return tolerances


def absolute_units(plant: PlantDescription) -> dict[str, str]:
    """Units of the tolerances that are not relative: of offsets, start levels and parameters of effects."""
    offsets = {f"{sensor.name}.offset": sensor.unit for sensor in plant.sensors}
    return offsets | {f"{tank.name}.start_level": "m" for tank in plant.tanks} | effect_units(plant)


def effect_units(plant: PlantDescription) -> dict[str, str]:
    """Units of all parameters of the plant's effects, by full name."""
    return {
        e.full_name(name): parameter.unit
        for e in plant.effects
        for name, parameter in effect_parameters(e.effect, e.location, plant).items()
    }


def _constants(plant: PlantDescription) -> list[str]:
    """Names of the constants that can have a tolerance."""
    tanks = [f"{tank.name}.{name}" for tank in plant.tanks for name in ("area", "height", "start_level")]
    flows = [
        f"{c.name}.{name}" for c in plant.flow_components() for name, _, role in c.constants() if role == "estimated"
    ]
    return [*tanks, *flows, *(f"{sensor.name}.{name}" for sensor in plant.sensors for name in ("gain", "offset"))]


def _further_flows(given: Mapping[str, Iterable[FlowComponent]]) -> dict[str, Any]:
    """The components of further kinds by part. Raises TypeError for an unknown part."""
    parts = [kind.part() for kind in FLOW_KINDS]
    for part in given:
        if part not in parts:
            raise TypeError(unknown("an argument of Plant", part, parts))
    return {part: tuple(components) for part, components in given.items()}
