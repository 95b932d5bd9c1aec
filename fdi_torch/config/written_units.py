"""Units for display: those in which the user wrote the quantities of a plant file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from fdi_torch.plant.description import READING_UNITS
from fdi_torch.quantities import SI_UNITS
from fdi_torch.units import UnitError, number_and_unit, same_kind, spelled

_FIRST = ("tanks", "sensors", "pumps")
_NOT_CHOSEN = ("1", "s")  # a share is written in % where it is a tolerance, and times are displayed in s


def written_units(data: Mapping[str, Any]) -> dict[str, str]:
    """The units for display that follow from the mapping of a plant file: by SI unit, channel, and gain of a pump.

    A quantity is displayed in the unit in which the file first writes a quantity of that kind, tanks first, then
    sensors and pumps. A sensor whose gain has a unit, such as 16.7 %/m, is displayed in the unit of its readings (%).
    Where the gain of a pump or transfer is written per %, which has no dimension, so are gain and command displayed.
    """
    units: dict[str, str] = {}
    for unit in _units_in([data.get(part) for part in _FIRST] + [v for k, v in data.items() if k not in _FIRST]):
        si_unit = same_kind(unit, (*SI_UNITS, *READING_UNITS))
        if si_unit is not None and si_unit not in _NOT_CHOSEN:
            units.setdefault(si_unit, spelled(unit))
    sensors = data.get("sensors")
    for name, sensor in sensors.items() if isinstance(sensors, dict) else ():
        reading = _reading_unit(sensor)
        if reading is not None:
            units[str(sensor.get("channel") or name)] = spelled(reading)
    for part in (part for name, part in data.items() if name != "sensors" and isinstance(part, dict)):
        for name, component in part.items():
            gain = component.get("gain") if isinstance(component, Mapping) else None
            for unit in (unit for unit in _units_in(gain) if unit.endswith("/%")):
                units |= {f"{name}.gain": spelled(unit), str(component.get("command") or name): "%"}
    return units


def _units_in(value: Any) -> Iterator[str]:
    """The units of all quantities in a nested value, in their order."""
    if isinstance(value, str):
        try:
            yield number_and_unit(value)[1]
        except UnitError:
            return
    elif isinstance(value, Mapping | list):
        for each in value.values() if isinstance(value, Mapping) else value:
            yield from _units_in(each)


def _reading_unit(sensor: Any) -> str | None:
    """The unit of a sensor's readings: of its offset or limits, or the numerator of its gain's unit."""
    if not isinstance(sensor, Mapping):
        return None
    for unit in _units_in([sensor.get(key) for key in ("offset", "low", "high")]):
        return unit if same_kind(unit, (*READING_UNITS.values(),)) else None
    for unit in _units_in(sensor.get("gain")):
        reading, divided, _ = unit.rpartition("/")
        return reading if divided and same_kind(reading, (*READING_UNITS.values(),)) else None
    return None
