"""Plant files: YAML with units -> PlantDescription in SI."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError

from fdi_torch.config.files import find_plant, read_yaml
from fdi_torch.config.problems import ConfigError, explain
from fdi_torch.config.strict import Acceleration, Amount, Area, Flow, Length, Share, Strict, quantity
from fdi_torch.effects import effect
from fdi_torch.names import matching, unknown
from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import COMMAND_UNITS, OUTSIDE, Pipe, PlacedEffect, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.effect import Effect, fits, place_kind

SENSOR_UNITS = {"1": "m", "Pa/m": "Pa", "V/m": "V", "A/m": "A", "1/m": "1"}
"""Unit of a sensor's gain -> SI unit of its reading."""


def _start_level(value: Any) -> float | None:
    return None if value in (None, "equilibrium") else quantity(value, "m")


MOST_DISCHARGE = 10.0  # more is no orifice's coefficient, effective or not, but per cent without their sign


class TankConfig(Strict):
    area: Area = Field(description="cross-section, m^2")
    height: Length = Field(description="from the floor to the rim, m")
    start_level: Annotated[float | None, BeforeValidator(_start_level)] = Field(
        None, description="level at t = 0, m, or equilibrium (of the first inputs)"
    )
    overflow_to: str = Field(OUTSIDE, description="the tank that catches what runs over the rim")
    leak_reference: str | None = Field(None, description="the pipe whose capacity a leak's size is a share of")


class PipeConfig(Strict):
    source: str = Field(description="the tank it starts from")
    target: str = Field(OUTSIDE, description="the tank it leads to, or outside")
    area: Area = Field(description="of the orifice, m^2")
    discharge_coefficient: Share = Field(le=MOST_DISCHARGE, description="of the orifice, without unit")
    elevation: Length = Field(0.0, description="of the orifice above both floors, m")
    free_fall: bool = Field(False, description="whether it pours into its target from above")
    valve: str | None = Field(None, description="the input channel with its measured opening, 0 to 1")
    unrecorded: Share | None = Field(None, ge=0, le=1, description="its opening in recordings that lack the channel")


class PumpConfig(Strict):
    target: str = Field(description="the tank it fills")
    max_flow: Flow = Field(description="what it can deliver at most, m^3/s")
    gain: Amount = Field(1.0, description="flow for a command of 1: none, l/min/V, l/min/mA, l/min/Hz; l/min of a duty")
    command: str | None = Field(None, description="its input channel, where that is not its name")


class SensorConfig(Strict):
    tank: str = Field(description="the tank whose level it reads")
    gain: Amount = Field(1.0, description="reading for a level of 1: no unit, or in mbar/cm, V/cm, mA/cm, %/cm")
    offset: Amount | None = Field(None, description="reading at level 0, in the reading's unit")
    channel: str | None = Field(None, description="its output channel, where that is not its name")
    low: Amount | None = Field(None, description="it never reads less, in the reading's unit")
    high: Amount | None = Field(None, description="it never reads more, in the reading's unit")


class EffectConfig(Strict):
    effect: str = Field(description="which effect, such as pump_lag")
    location: str = Field(description="the component that has it")
    parameters: dict[str, Amount] = Field(default_factory=dict, description="with units, such as time_constant: 8 s")


class PlantConfig(Strict):
    name: str = ""
    gravity: Acceleration = Field(9.81, description="m/s^2")
    tanks: dict[str, TankConfig]
    pipes: dict[str, PipeConfig] = Field(default_factory=dict)
    pumps: dict[str, PumpConfig] = Field(default_factory=dict)
    sensors: dict[str, SensorConfig] = Field(default_factory=dict)
    tolerances: dict[str, Amount] = Field(
        default_factory=dict,
        description="one standard deviation of a constant as a share of it (of an offset, or a parameter of an effect: "
        "in its unit); * is any name",
    )
    varying: list[str] = Field(
        default_factory=list, description="constants with a tolerance that are others in each recording; * is any name"
    )
    effects: list[EffectConfig] = Field(default_factory=list, description="what the plant is known to have")


def load_plant(name: str | Path, base: Path | None = None) -> PlantDescription:
    """The plant in a file, or one that is shipped, by its name ('three_tank'). Raises ConfigError."""
    path = find_plant(str(name), base or Path.cwd())
    data = read_yaml(path)
    return build_plant({"name": path.stem, **data}, str(path))


def build_plant(data: dict[str, Any], source: str) -> PlantDescription:
    """The plant in a mapping. Raises ConfigError, naming `source` and the field."""
    try:
        config = PlantConfig.model_validate(data)
    except ValidationError as error:
        raise explain(error, source) from None
    try:
        return _description(config)
    except ValueError as error:
        raise ConfigError([f"{source}: {error}"]) from error


def _description(config: PlantConfig) -> PlantDescription:
    sensors = tuple(_sensor(name, sensor) for name, sensor in config.sensors.items())
    plant = PlantDescription(
        name=config.name,
        tanks=tuple(Tank(name, **dict(tank)) for name, tank in config.tanks.items()),
        pipes=tuple(Pipe(name, **dict(pipe)) for name, pipe in config.pipes.items()),
        pumps=tuple(_pump(name, pump) for name, pump in config.pumps.items()),
        sensors=sensors,
        gravity=config.gravity,
    )
    plant = replace(plant, effects=tuple(_effect(i, e, plant) for i, e in enumerate(config.effects)))
    tolerances = _tolerances(config, plant)
    return replace(plant, tolerances=tolerances, varying=_varying(config.varying, tolerances))


def _pump(name: str, pump: PumpConfig) -> Pump:
    gain, unit = _amount_in_one_of(f"pumps.{name}.gain", pump.gain, tuple(COMMAND_UNITS))
    return Pump(name, pump.target, pump.max_flow, gain, pump.command, unit)


def _sensor(name: str, sensor: SensorConfig) -> Sensor:
    gain, gain_unit = _amount_in_one_of(f"sensors.{name}.gain", sensor.gain, tuple(SENSOR_UNITS))
    unit = SENSOR_UNITS[gain_unit]

    def reading(field: Literal["offset", "low", "high"]) -> float | None:
        value = getattr(sensor, field)
        return None if value is None else _amount(f"sensors.{name}.{field}", value, unit)

    offset = reading("offset") or 0.0
    return Sensor(name, sensor.tank, unit, gain, offset, sensor.channel, reading("low"), reading("high"))


def _effect(index: int, config: EffectConfig, plant: PlantDescription) -> PlacedEffect:
    place = f"effects.{index}"
    try:
        known = effect_parameters(config.effect, config.location, plant)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error
    for name in config.parameters:
        if name not in known:
            raise ValueError(f"{place}.parameters: {unknown(f'a parameter of {config.effect}', name, known)}")
    values = {n: _amount(f"{place}.parameters.{n}", v, known[n].unit) for n, v in config.parameters.items()}
    return PlacedEffect(config.effect, config.location, values)


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


def _tolerances(config: PlantConfig, plant: PlantDescription) -> dict[str, float]:
    """Patterns such as *.discharge_coefficient spelled out for every constant that they match; later ones win.

    A pattern for parameters of effects has two dots.
    """
    units = absolute_units(plant)
    known = [*_constants(config), *effect_units(plant)]
    tolerances: dict[str, float] = {}
    for pattern, value in config.tolerances.items():
        place = f"tolerances.{pattern}"
        matched = [n for n in known if fnmatchcase(n, pattern) and n.count(".") == max(pattern.count("."), 1)]
        if not matched:
            raise ValueError(f"{place}: {unknown('a constant', pattern, known)}")
        for name in matched:
            tolerances[name] = _amount(place, value, units.get(name, "1"))
            if not tolerances[name] > 0:
                raise ValueError(f"{place}: expected a positive tolerance such as 3 %, got {value}")
    return tolerances


def _varying(patterns: Sequence[str], tolerances: dict[str, float]) -> tuple[str, ...]:
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


def _constants(config: PlantConfig) -> list[str]:
    fields: Sequence[tuple[dict[str, Any], tuple[str, ...]]] = (
        (config.tanks, ("area", "height", "start_level")),
        (config.pipes, ("area", "discharge_coefficient")),
        (config.pumps, ("gain", "max_flow")),
        (config.sensors, ("gain", "offset")),
    )
    return [f"{name}.{field}" for components, names in fields for name in components for field in names]


def _amount_in_one_of(place: str, value: Amount, units: tuple[str, ...]) -> tuple[float, str]:
    for unit in units:
        try:
            return quantity(value, unit), unit
        except ValueError:
            continue
    raise ValueError(f"{place}: expected a quantity in {' or '.join(units)}, got '{value}'")


def _amount(place: str, value: Amount, unit: str) -> float:
    try:
        return quantity(value, unit)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error
