"""Plant files: YAML with units -> `Plant` in SI."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sized
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import pydantic
from pydantic import Field

from fdi_torch.config.plant_in_code import Plant, effect_in_si, effect_parameters, si_value, tolerances_in_si
from fdi_torch.config.problems import ConfigError, Source, naming, validated
from fdi_torch.config.strict import Acceleration, Amount, Strict, quantity, quantity_of
from fdi_torch.config.written_units import written_units
from fdi_torch.config.yaml_files import expect_kind, find_plant, read_yaml
from fdi_torch.effects import units_for_display
from fdi_torch.names import unknown
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.components import Component
from fdi_torch.plant.description import (
    FLOW_KINDS,
    READING_UNITS,
    FaultPriority,
    PlacedEffect,
    PlantDescription,
    Sensor,
    Tank,
)
from fdi_torch.quantities import SI_UNITS, display_in, displayed_in, unit_factor
from fdi_torch.untrusted_input import MOST_COMPONENTS

AnyPlant = PlantDescription | str | Path
"""A plant, or the name of its file, or of a shipped one."""


def component_sections(base: type[Strict]) -> type[Strict]:
    """The model `base` with one mapping of components by name for each kind: `tanks`, `pipes` and others."""
    sections: dict[str, Any] = {"tanks": (_components(Tank), ...)}
    sections |= {kind.part(): (_components(kind), Field(default_factory=dict)) for kind in FLOW_KINDS}
    return pydantic.create_model(f"{base.__name__}WithComponents", __base__=base, **sections)


def _components(kind: type[Component]) -> Any:
    """Mapping of names to components of a kind, with a key for each field that has a meaning in plant files."""
    hints = get_type_hints(kind)
    keys: dict[str, Any] = {f.name: _key(f, hints[f.name]) for f in written_fields(kind)}
    return dict[str, pydantic.create_model(f"{kind.__name__}Config", __base__=Strict, **keys)]  # type: ignore[misc]


def written_fields(kind: type[Component]) -> list[dataclasses.Field[Any]]:
    """The fields of a kind that plant files have."""
    return [f for f in fields(kind) if "meaning" in f.metadata]  # type: ignore[arg-type]


def written_default(field: dataclasses.Field[Any]) -> Any:
    """The value of a field that a plant file leaves out; MISSING if it is required."""
    return field.metadata.get("written_default", field.default)


def _key(field: dataclasses.Field[Any], hint: Any) -> tuple[Any, Any]:
    meta, default = field.metadata, written_default(field)
    annotation = hint
    if "unit_field" in meta:
        annotation = Amount
    elif "unit" in meta:
        annotation = Annotated[float, *quantity_of(meta["unit"])]
        if default is None:
            none = pydantic.BeforeValidator(lambda value: None if value == meta["none"] else value)
            annotation = Annotated[annotation | None, none]
    return annotation, Field(
        ... if default is MISSING else default, description=meta["meaning"], ge=meta.get("least"), le=meta.get("most")
    )


MARK = re.compile(r"\s*([\w.-]+):[^#]*#\s*!\s*(.*\S)\s*")
"""An entry whose comment begins with an exclamation mark."""
PLACEHOLDERS = "these entries are still placeholders; correct each, and delete its !"


class SensorConfig(Strict):
    tank: str = Field(description="the tank whose level it reads")
    gain: Amount = Field(1.0, description="reading for a level of 1: no unit, or in mbar/cm, V/cm, mA/cm, %/cm")
    offset: Amount | None = Field(None, description="reading at level 0, in the reading's unit")
    channel: str | None = Field(None, description="its output channel, if it differs from its name")
    low: Amount | None = Field(None, description="lowest reading, in its unit")
    high: Amount | None = Field(None, description="highest reading, in its unit")


class EffectConfig(Strict):
    effect: str = Field(description="name of the effect, such as pump_lag")
    location: str = Field(description="the component that has it")
    parameters: dict[str, Amount] = Field(default_factory=dict, description="with units, such as time_constant: 8 s")


class MatterConfig(Strict):
    smallest: Amount = Field(0.0, description="smallest deviation from nominal that is reported, with its unit")
    urgency: str = Field("", description="a word that is added to its events, such as high")


class _NamedPlant(Strict):
    name: str = ""
    gravity: Acceleration = Field(9.81, description="m/s^2")


class PlantConfig(component_sections(_NamedPlant)):  # type: ignore[misc]
    sensors: dict[str, SensorConfig] = Field(default_factory=dict)
    tolerances: dict[str, Amount] = Field(
        default_factory=dict,
        description="relative standard deviation of a constant (of an offset, a start level or an effect's parameter: "
        "in its unit); * is any name",
    )
    varying: list[str] = Field(
        default_factory=list, description="constants with a tolerance that differ between recordings; * is any name"
    )
    effects: list[EffectConfig] = Field(default_factory=list, description="known effects of the plant")
    matters: dict[str, MatterConfig] = Field(
        default_factory=dict, description="smallest reported size and urgency of faults by name, such as T1.leak"
    )
    units: dict[str, str] = Field(
        default_factory=dict,
        description="units for display by SI unit, channel or gain of a pump, such as m: mm; by default those of this "
        "file",
    )


def load_plant(name: str | Path, base: Path | None = None, unfinished: bool = False) -> Plant:
    """The plant in a file, or a shipped one by its name ('three_tank').

    unfinished: also with entries that are still placeholders. Raises ConfigError.
    """
    path = find_plant(str(name), base or Path.cwd())
    data = read_yaml(path)
    expect_kind(data, "plant", path)
    if not unfinished and (guesses := placeholders(path)):
        raise ConfigError([f"{path}: {PLACEHOLDERS}: {'; '.join(guesses)}"])
    return build_plant({"name": path.stem, **data}, str(path))


def given_plant(plant: AnyPlant, unfinished: bool = False) -> PlantDescription:
    """The plant itself, or that of a file or of a shipped name; unfinished as of `load_plant`.

    Raises ConfigError, and TypeError for another type.
    """
    if isinstance(plant, str | Path):
        return load_plant(plant, unfinished=unfinished)
    if not isinstance(plant, PlantDescription):
        raise TypeError(f"plant: expected a Plant or the name of a plant file, got a {type(plant).__name__}")
    return plant


def chosen_plant(plant: AnyPlant, unfinished: bool = False) -> PlantDescription:
    """As `given_plant`, for the plant that a command is about: from now on quantities are displayed in its units."""
    chosen = given_plant(plant, unfinished)
    display_in(units_for_display(chosen))
    return chosen


def placeholders(path: Path) -> list[str]:
    """The entries that a new plant file marks with ! as guesses: 'line 5, tanks: cross-section'."""
    marked = ((number, MARK.match(line)) for number, line in enumerate(path.read_text("utf-8").splitlines(), 1))
    return [f"line {number}, {match[1]}: {match[2]}" for number, match in marked if match]


def build_plant(data: dict[str, Any], source: str) -> Plant:
    """The plant in a mapping. Raises ConfigError, naming `source` and the field."""
    config = validated(PlantConfig, data, Source(source))
    written = written_units(data)
    with naming(source), displayed_in(written):  # messages about numbers are in the units of the file
        plant = _plant(config)
        return replace(plant, units=written | _valid_units(config.units, plant))


def _valid_units(units: dict[str, str], plant: Plant) -> dict[str, str]:
    """The key `units`. Raises ValueError for an unknown key, and for a unit of another kind than its key."""
    gains = {f"{c.name}.gain": c.gain_unit for c in plant.metered_flows()}
    known = {kind: kind for kind in (*SI_UNITS, *READING_UNITS)} | gains | plant.channel_units() | plant.output_units()
    for key, unit in units.items():
        if key not in known:
            raise ValueError(f"units: {unknown('a channel, the gain of a pump or an SI unit', key, known)}")
        with naming(f"units.{key}"):
            unit_factor(unit, known[key])
    return units


def _plant(config: PlantConfig) -> Plant:
    flows: dict[Any, dict[str, Strict]] = {kind: getattr(config, kind.part()) for kind in FLOW_KINDS}
    kinds: tuple[Sized, ...] = (config.tanks, *flows.values(), config.sensors, config.effects)
    parts = sum(len(kind) for kind in kinds)
    if parts > MOST_COMPONENTS:
        raise ValueError(f"expected at most {MOST_COMPONENTS} components and effects, got {parts}; split the plant")
    components: dict[str, Any] = {
        kind.part(): [kind(name, **dict(keys)) for name, keys in given.items()] for kind, given in flows.items()
    }
    tanks = [Tank(name, **dict(tank)) for name, tank in config.tanks.items()]
    for tank in tanks:
        tank.check_level(tank.start_level, f"tanks.{tank.name}.start_level")
    plant = Plant(
        tanks=tanks,
        sensors=[_sensor(name, sensor) for name, sensor in config.sensors.items()],
        gravity=config.gravity,
        name=config.name,
        **components,
    )
    placed = [PlacedEffect(e.effect, e.location, e.parameters) for e in config.effects]  # type: ignore[arg-type]
    plant = replace(plant, effects=tuple(effect_in_si(i, e, plant, quantity) for i, e in enumerate(placed)))
    tolerances = tolerances_in_si(config.tolerances, plant, quantity)
    matters = tuple(_matter(name, matter, plant) for name, matter in config.matters.items())
    return replace(plant, tolerances=tolerances, varying=tuple(config.varying), matters=matters)


def _matter(name: str, matter: MatterConfig, plant: Plant) -> FaultPriority:
    """The priority of a fault; 'T1.leak' means the leak's size."""
    at = ParameterName.of_effect(name)
    with naming(f"matters.{name}"):
        parameters = effect_parameters(at.effect, at.place, plant)
    size = parameters.get(at.field or next(iter(parameters)))
    if size is None:
        raise ValueError(f"matters.{name}: {unknown('a parameter', at.field, parameters)}")
    smallest = si_value(f"matters.{name}.smallest", matter.smallest, size.unit, quantity)
    if smallest < 0.0:
        raise ValueError(f"matters.{name}.smallest: expected no negative size, got {matter.smallest}")
    return FaultPriority(str(at.sibling(size.name)), smallest, matter.urgency)


def _sensor(name: str, config: SensorConfig) -> Sensor:
    sensor = Sensor(name, config.tank, gain=config.gain, channel=config.channel)  # type: ignore[arg-type]
    given: dict[str, Any] = {}
    for field in ("offset", "low", "high"):
        if (value := getattr(config, field)) is not None:
            given[field] = si_value(f"sensors.{name}.{field}", value, sensor.unit, quantity)
    return replace(sensor, **given)
