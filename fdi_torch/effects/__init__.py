"""The effects: faults and unmodelled effects, one file each. A new effect needs its file and its name in `EFFECTS`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING

from fdi_torch.names import nearest, shortened, unknown
from fdi_torch.parameters import ParameterName, ParameterSpace
from fdi_torch.plant.description import PlantDescription, with_tolerances
from fdi_torch.plant.effect import Effect, Placement, fits, place_kind, place_kinds_of

if TYPE_CHECKING:
    from fdi_torch.plant.network import TankNetwork


def _loaded(name: str) -> Effect:
    """The effect of a file: pump_lag.py holds the class PumpLag."""
    effect: Effect = getattr(import_module(f"fdi_torch.effects.{name}"), name.title().replace("_", ""))()
    return effect


# Of two effects at one place, the earlier one acts first.
EFFECTS: tuple[Effect, ...] = tuple(
    _loaded(name)
    for name in (
        # of commands
        *("actuator_stuck", "actuator_slew", "pump_lag", "pump_delay", "pump_dead_zone", "pump_priming"),
        *("valve_lag", "valve_dead_zone", "valve_characteristic", "valve_authority", "valve_leak"),
        # of flows
        *("pump_gain", "pump_curve", "pump_back_pressure", "pump_oscillation", "pump_offset", "pump_cut_out"),
        *("pump_saturation", "laminar_flow", "flow_exponent", "outlet_drop", "coefficient_drift", "plugging"),
        *("net_outlet", "openness", "pipe_inertia", "cross_flow", "leak", "unmetered_flow", "evaporation", "overflow"),
        # of cross-sections
        *("area_taper", "internal_body"),
        # of readings
        *("sensor_lag", "sensor_delay", "sensor_hysteresis", "sensor_curvature", "sensor_gain", "sensor_bias"),
        *("sensor_drift", "sensor_oscillation", "sensor_stuck", "sensor_floor", "sensor_saturation"),
        "sensor_quantization",
    )
)


def effect(name: str) -> Effect:
    """The effect of that name. Raises ValueError, with similar names, for an unknown one."""
    by_name = {e.name: e for e in EFFECTS}
    if name not in by_name:
        near = nearest(name, by_name) or "; fdi effects lists them"
        raise ValueError(f"expected an effect of the library, got '{shortened(name)}'{near}")
    return by_name[name]


def place(name: str, location: str) -> Placement:
    """An effect at a location: place("leak", "T1"). It is absent until its size leaves the nominal value."""
    return Placement(effect(name), location)


def all_placements(plant: PlantDescription, effects: Iterable[Effect] = EFFECTS) -> tuple[Placement, ...]:
    """Every effect at every place where it can be placed."""
    return tuple(Placement(e, place) for e in effects for place in plant.locations() if fits(e, plant, place))


def effects_of(plant: PlantDescription) -> list[Placement]:
    """The effects that the plant is known to have."""
    return [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]


def build_network(plant: PlantDescription, placements: Iterable[Placement] = ()) -> TankNetwork:
    """The network of a plant with its known effects, and with further ones to be estimated.

    A further placement is ignored if the plant already has that effect at that place.
    """
    from fdi_torch.plant.network import TankNetwork  # a module of torch, which the catalogue does without

    known = effects_of(plant)
    prefixes = {p.prefix for p in known}
    return TankNetwork(plant, [*known, *(p for p in placements if p.prefix not in prefixes)])


def units_for_display(plant: PlantDescription) -> dict[str, str]:
    """The plant's units, and by full name those of parameters that are readings of a sensor with a unit of its own; and
    the words for the effects of pumps at other components, such as 'transfer gain' for 'recycle.pump_gain'.

    Readings in % have no dimension, as factors have none: a parameter is a reading if its unit follows the sensor's.
    """
    units = dict(plant.units)
    for component in (c for c in plant.flow_components() if c.place_kind != "pump"):
        of_pumps = (name for name in component.accepts if name.startswith("pump_"))
        words = {name: name.replace("pump", component.place_kind, 1).replace("_", " ") for name in of_pumps}
        units |= {f"{component.name}.{name}": text for name, text in words.items()}
    for sensor in plant.sensors:
        if (own := plant.units.get(sensor.column)) is None:
            continue
        units[f"{sensor.name}.offset"] = own
        other = replace(sensor, unit="V" if sensor.unit != "V" else "A")
        changed = replace(plant, sensors=tuple(other if s == sensor else s for s in plant.sensors))
        for each in (e for e in EFFECTS if fits(e, plant, sensor.name)):
            pairs = zip(each.parameters(sensor.name, plant), each.parameters(sensor.name, changed), strict=True)
            for here, there in pairs:
                if here.unit != there.unit and there.unit.startswith(other.unit):
                    full = str(ParameterName(sensor.name, each.name, here.name))
                    units[full] = own + there.unit.removeprefix(other.unit)
    return units


def without_startup_effects(plant: PlantDescription, channels: Collection[str]) -> PlantDescription:
    """The plant without its start-up effects, for data from the middle of a run in which the pumps of `channels` have
    run.

    The tolerances and varying constants of those effects are removed too.
    """
    given = [(component.name, component.input_channel) for component in plant.flow_components()]
    running = {name for name, channel in given if channel is not None and channel[0] in channels}
    ended = {e.prefix for e in plant.effects if e.location in running and effect(e.effect).startup_only}
    effects = tuple(e for e in plant.effects if e.prefix not in ended)
    return replace(with_tolerances(plant, lambda name: name.prefix not in ended), effects=effects)


def effect_at(name: str, location: str, plant: PlantDescription) -> Effect:
    """The effect of that name. Raises ValueError if it cannot be placed there."""
    requested = effect(name)
    if not fits(requested, plant, location):
        possible = ", ".join(place for place in plant.locations() if fits(requested, plant, place)) or "none there is"
        raise ValueError(
            f"{location}.{name}: expected a place of kind {' or '.join(place_kinds_of(requested))} ({possible}), "
            f"got {place_kind(plant, location)} {location}"
        )
    return requested


def full_name(name: str, plant: PlantDescription) -> str:
    """'T1.leak' -> 'T1.leak.size': an effect's name means its size. Other names are returned unchanged.

    Raises ValueError for an effect at an impossible place.
    """
    at = ParameterName.of_effect(name)
    if at.field or at.effect not in {e.name for e in EFFECTS}:
        return name
    return str(at.sibling(effect_at(at.effect, at.place, plant).parameters(at.place, plant)[0].name))


def unknown_parameter(name: str, constants: ParameterSpace, plant: PlantDescription) -> str:
    """The message for a name that is neither a constant of the plant nor a parameter of an effect."""
    effects = [p.prefix for p in all_placements(plant)]
    prefix = name.rpartition(".")[0]
    fields = [known for known in constants.names if known.startswith(f"{prefix}.")]
    if prefix in effects and fields:
        return f"expected {' or '.join(fields)}, got '{shortened(name)}'; the size is {fields[0]}"
    candidates = (*constants.names, *effects)
    sentence = unknown("a parameter of the plant or its faults", name, candidates)
    return sentence.replace(f" ({', '.join(candidates)})", "")


def placements_for(names: Iterable[str]) -> tuple[Placement, ...]:
    """The distinct effects behind parameter names such as 'T1.leak.size'; names of component constants are ignored."""
    pairs = dict.fromkeys((n.effect, n.place) for n in map(ParameterName.parse, names) if n.effect)
    return tuple(place(effect_name, location) for effect_name, location in pairs)
