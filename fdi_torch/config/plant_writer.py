"""Writing of plant files: PlantDescription in SI -> YAML with units that reads back as the same description."""

from __future__ import annotations

from typing import Any

from fdi_torch.config.plant_file import AnyPlant, given_plant, written_fields
from fdi_torch.config.plant_in_code import absolute_units, effect_parameters
from fdi_torch.config.written_units import written_units
from fdi_torch.config.yaml_files import write_yaml
from fdi_torch.effects import effect_at
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.components import Component
from fdi_torch.plant.description import FLOW_KINDS, READING_UNITS, FaultPriority, PlacedEffect, PlantDescription, Sensor
from fdi_torch.quantities import display_unit, displayed_in, parse_quantity

_UNITS = {
    "m": ("cm", "mm", "m", "dm", "ft", "in"),
    "m^2": ("cm^2", "mm^2", "m^2", "dm^2", "ft^2", "in^2"),
    "m^3/s": ("cm^3/s", "l/min", "m^3/h", "gallon/min"),
    "m^3/s/V": ("cm^3/s/V", "l/min/V", "m^3/h/V"),
    "m^3/s/A": ("cm^3/s/mA", "l/min/mA", "m^3/h/mA"),
    "Pa": ("mbar", "kPa"),
    "Pa/m": ("mbar/cm", "kPa/m"),
    "A": ("mA",),
    "A/m": ("mA/m", "mA/cm"),
    "1/m": ("1/m", "%/m", "%/cm"),
}
"""SI unit -> customary units, the usual one first."""
SMALLEST = 0.01  # number that is written in the unit for display; a smaller one is written in a smaller unit


def dump_plant(plant: AnyPlant) -> str:
    """The text of a plant file that reads back as the same plant, which is given itself or by its name."""
    return write_yaml(plant_mapping(given_plant(plant)))


def plant_mapping(plant: PlantDescription) -> dict[str, Any]:
    """The description as the mapping that `build_plant` reads: quantities as text given in code, such as '45 cm', and
    others in the plant's units where these are exact.
    """
    with displayed_in(plant.units):
        data: dict[str, Any] = {"name": plant.name, "gravity": f"{plant.gravity!r} m/s^2"}
        data["tanks"] = {t.name: _component_mapping(t) for t in plant.tanks}
        for kind in FLOW_KINDS:
            data[kind.part()] = {c.name: _component_mapping(c) for c in getattr(plant, kind.part())}
        data["sensors"] = {s.name: _sensor_mapping(s) for s in plant.sensors}
        units = absolute_units(plant)
        shares = _shares({n: v for n, v in plant.tolerances.items() if n not in units})
        data["tolerances"] = {n: shares[n] if n in shares else _text(v, units[n]) for n, v in plant.tolerances.items()}
        data["varying"] = list(plant.varying)
        data["effects"] = [_effect_mapping(placed, plant) for placed in plant.effects]
        data["matters"] = {m.fault: _matter_mapping(m, plant) for m in plant.matters}
    data = {key: value for key, value in data.items() if value}
    return data | ({"units": plant.units} if plant.units and written_units(data) != plant.units else {})


def _matter_mapping(matter: FaultPriority, plant: PlantDescription) -> dict[str, Any]:
    at = ParameterName.parse(matter.fault)
    units = {p.name: p.unit for p in effect_at(at.effect, at.place, plant).parameters(at.place, plant)}
    smallest = _text(matter.smallest, units[at.field]) if matter.smallest else None
    return _given(smallest=smallest, urgency=matter.urgency or None)


def _component_mapping(component: Component) -> dict[str, Any]:
    """The keys of a tank or flow component whose values differ from their defaults, `target` always."""
    mapping: dict[str, Any] = {}
    for f in written_fields(type(component)):
        value, unit = getattr(component, f.name), f.metadata.get("unit", "")
        if "unit_field" in f.metadata:
            unit = getattr(component, f.metadata["unit_field"])
        is_default = value == f.default and unit in ("", "1", f.metadata.get("unit"))
        if not is_default:
            text = component.written.get(f.name) or (
                _text(value, unit, f"{component.name}.{f.name}") if unit else value
            )
            mapping[f.name] = text
    return mapping


def _sensor_mapping(sensor: Sensor) -> dict[str, Any]:
    gain_unit = next(gain for gain, unit in READING_UNITS.items() if unit == sensor.unit)

    def text(field: str, value: float | None, unit: str) -> str | float | None:
        return None if value is None else sensor.written.get(field) or _text(value, unit)

    return _given(
        tank=sensor.tank,
        gain=None if sensor.gain == 1.0 and sensor.unit == "m" else text("gain", sensor.gain, gain_unit),
        offset=text("offset", sensor.offset, sensor.unit) if sensor.offset else None,
        channel=sensor.channel,
        low=text("low", sensor.low, sensor.unit),
        high=text("high", sensor.high, sensor.unit),
    )


def _effect_mapping(placed: PlacedEffect, plant: PlantDescription) -> dict[str, Any]:
    known = effect_parameters(placed.effect, placed.location, plant)
    values = {name: _text(value, known[name].unit) for name, value in placed.parameters.items()}
    return {"effect": placed.effect, "location": placed.location, "parameters": values}


def _given(**fields: Any) -> dict[str, Any]:
    return {key: value for key, value in fields.items() if value is not None}


def _shares(values: dict[str, float]) -> dict[str, str | float]:
    """Relative tolerances as text: all in per cent, such as '3 %'. If rounding makes one of these texts read back as
    another number than it was written from, all are written as plain numbers instead.
    """
    percents = {n: f"{100.0 * v:.9g} %" for n, v in values.items()}
    exact = all(parse_quantity(percents[n], "1") == v for n, v in values.items())
    return {n: percents[n] if exact else v for n, v in values.items()}


def _text(value: float, unit: str, name: str = "") -> str | float:
    """A quantity as text, such as '160 cm^2', that reads back as exactly the same value.

    The unit is the one for display if the number in it has at most 9 digits and is at least `SMALLEST`, else the first
    customary unit for which that holds. If it holds for none, the number gets as many digits as it needs.
    """
    if unit == "1":
        return value
    shown, _ = display_unit(unit, name)
    units = dict.fromkeys((shown, *_UNITS.get(unit, ()), unit))
    of_its_own = shown != display_unit(unit)[0]  # as of a gain per %, whose command has the unit too
    for digits in range(9, 18):
        numbers = {u: f"{value / parse_quantity(f'1 {u}', unit):.{digits}g}" for u in units}
        exact = [u for u in units if parse_quantity(f"{numbers[u]} {u}", unit) == value]
        large = [u for u in exact if abs(float(numbers[u])) >= SMALLEST or of_its_own or digits > 9]
        if best := [*large, *exact]:
            return f"{numbers[best[0]]} {best[0]}"
    return f"{value!r} {unit}"
