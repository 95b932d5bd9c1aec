"""Writing of plant files: PlantDescription in SI -> YAML with units that reads back as the same description."""

from __future__ import annotations

from typing import Any

from fdi_torch.config.plant_in_code import absolute_units, effect_at, effect_parameters
from fdi_torch.config.yaml_files import write_yaml
from fdi_torch.parameters import parse_quantity
from fdi_torch.plant.description import (
    OUTSIDE,
    READING_UNITS,
    FaultPriority,
    Pipe,
    PlacedEffect,
    PlantDescription,
    Pump,
    Sensor,
    Tank,
)

_UNITS = {
    "m": ("cm", "mm", "m", "ft", "in"),
    "m^2": ("cm^2", "mm^2", "m^2", "ft^2", "in^2"),
    "m^3/s": ("cm^3/s", "l/min", "m^3/h", "gallon/min"),
    "m^3/s/V": ("cm^3/s/V", "l/min/V", "m^3/h/V"),
    "m^3/s/A": ("cm^3/s/mA", "l/min/mA", "m^3/h/mA"),
    "m/s^2": ("cm/s^2",),
    "Pa": ("mbar", "kPa"),
    "Pa/m": ("mbar/cm", "kPa/m"),
    "A": ("mA",),
    "A/m": ("mA/m", "mA/cm"),
    "1/m": ("1/m", "%/m", "%/cm"),
}
"""SI unit -> customary units, the usual one first."""


def dump_plant(plant: PlantDescription) -> str:
    """A plant file that reads back as the same description."""
    return write_yaml(plant_mapping(plant))


def plant_mapping(plant: PlantDescription) -> dict[str, Any]:
    """The description as the mapping that `build_plant` reads."""
    data: dict[str, Any] = {"name": plant.name, "gravity": _text(plant.gravity, "m/s^2")}
    data["tanks"] = {t.name: _tank_mapping(t) for t in plant.tanks}
    data["pipes"] = {p.name: _pipe_mapping(p) for p in plant.pipes}
    data["pumps"] = {p.name: _pump_mapping(p) for p in plant.pumps}
    data["sensors"] = {s.name: _sensor_mapping(s) for s in plant.sensors}
    units = absolute_units(plant)
    data["tolerances"] = {name: _text(v, units.get(name, "1")) for name, v in plant.tolerances.items()}
    data["varying"] = list(plant.varying)
    data["effects"] = [_effect_mapping(placed, plant) for placed in plant.effects]
    data["matters"] = {m.fault: _matter_mapping(m, plant) for m in plant.matters}
    return {key: value for key, value in data.items() if value}


def _matter_mapping(matter: FaultPriority, plant: PlantDescription) -> dict[str, Any]:
    location, effect, field = matter.fault.split(".")
    units = {p.name: p.unit for p in effect_at(effect, location, plant).parameters(location, plant)}
    smallest = _text(matter.smallest, units[field]) if matter.smallest else None
    return _given(smallest=smallest, urgency=matter.urgency or None)


def _tank_mapping(tank: Tank) -> dict[str, Any]:
    start = None if tank.start_level is None else _text(tank.start_level, "m")
    outside = None if tank.overflow_to == OUTSIDE else tank.overflow_to
    return _given(
        area=_text(tank.area, "m^2"),
        height=_text(tank.height, "m"),
        start_level=start,
        overflow_to=outside,
        leak_reference=tank.leak_reference,
    )


def _pipe_mapping(pipe: Pipe) -> dict[str, Any]:
    return _given(
        source=pipe.source,
        target=pipe.target,
        area=_text(pipe.area, "m^2"),
        discharge_coefficient=pipe.discharge_coefficient,
        elevation=_text(pipe.elevation, "m") if pipe.elevation else None,
        free_fall=pipe.free_fall or None,
        valve=pipe.valve,
        unrecorded=pipe.unrecorded,
    )


def _pump_mapping(pump: Pump) -> dict[str, Any]:
    plain = pump.gain_unit == "1" and pump.gain == 1.0
    return _given(
        target=pump.target,
        max_flow=_text(pump.max_flow, "m^3/s"),
        gain=None if plain else _text(pump.gain, pump.gain_unit),
        command=pump.command,
    )


def _sensor_mapping(sensor: Sensor) -> dict[str, Any]:
    gain_unit = next(gain for gain, unit in READING_UNITS.items() if unit == sensor.unit)

    def reading(value: float | None) -> str | float | None:
        return None if value is None else _text(value, sensor.unit)

    return _given(
        tank=sensor.tank,
        gain=None if sensor.gain == 1.0 and sensor.unit == "m" else _text(sensor.gain, gain_unit),
        offset=reading(sensor.offset) if sensor.offset else None,
        channel=sensor.channel,
        low=reading(sensor.low),
        high=reading(sensor.high),
    )


def _effect_mapping(placed: PlacedEffect, plant: PlantDescription) -> dict[str, Any]:
    known = effect_parameters(placed.effect, placed.location, plant)
    values = {name: _text(value, known[name].unit) for name, value in placed.parameters.items()}
    return {"effect": placed.effect, "location": placed.location, "parameters": values}


def _given(**fields: Any) -> dict[str, Any]:
    return {key: value for key, value in fields.items() if value is not None}


def _text(value: float, unit: str) -> str | float:
    """'160 cm^2': the first customary unit in which the number is short and reads back exactly, else SI with all
    digits.
    """
    if unit == "1":
        return value
    for shown in (*_UNITS.get(unit, ()), unit):
        short = f"{value / parse_quantity(f'1 {shown}', unit):.9g} {shown}"
        if parse_quantity(short, unit) == value:
            return short
    return f"{value!r} {unit}"
