"""The configuration and the plant in a log. A log is untrusted: only plain YAML is read, and no file is opened."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, TypeAdapter, ValidationError

from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.problems import ConfigError, Source, explain
from fdi_torch.config.strict import with_known_keys
from fdi_torch.config.yaml_files import parse_yaml, shipped_plants
from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.names import unknown
from fdi_torch.plant.description import PlantDescription

if TYPE_CHECKING:
    from fdi_torch.gap.problem import Settings


def logged_mapping(log: LoggedRun) -> dict[str, Any]:
    """The configuration of a run as a mapping. Raises ConfigError if the log has none."""
    if "config.yaml" not in log.attachments:
        raise ConfigError([f"{log.path}: expected a configuration in the log, got none; the log cannot be replayed"])
    data = parse_yaml(log.attachment("config.yaml"), f"{log.path}: config.yaml")
    plant = data.get("plant")
    if isinstance(plant, str) and plant not in shipped_plants():  # a log may not name other files
        known = unknown("a plant, or a shipped one", plant, shipped_plants())
        raise ConfigError([f"{log.path}: config.yaml: plant: {known}"])
    return data


def logged_plant(log: LoggedRun) -> PlantDescription:
    """The plant of a run; the configuration may be a plant itself, or name a shipped one."""
    data = logged_mapping(log)
    plant = data.get("plant", data)
    if isinstance(plant, str):
        return load_plant(plant)
    if not isinstance(plant, dict):
        raise ConfigError([f"{log.path}: config.yaml: plant: expected a plant, got {type(plant).__name__}"])
    return build_plant({"name": "plant", **plant}, f"{log.path}: config.yaml")


def logged_gap_settings(log: LoggedRun, overrides: Iterable[str] = ()) -> Settings:
    """The logged settings of a gap diagnosis, of which older logs lack some, with overrides KEY=VALUE.

    Raises ConfigError for an unknown key or a wrong value, and if the log has no settings.
    """
    from fdi_torch.gap.problem import Settings  # loads torch, for which a list of logs does not wait

    logged, keys = log.about("config"), [field.name for field in fields(Settings)]
    values = {key: json.loads(text) for key in keys if (text := logged.get(f"settings.{key}")) is not None}
    if not values:
        raise ConfigError([f"{log.path}: expected the settings of a gap diagnosis, got none; run fdi gap again"])
    for override in overrides:
        key, _, text = override.partition("=")
        listed = key in ("library", "leave_out")
        values[key] = [name for name in text.split(",") if name] if listed else None if text == "null" else text
    values["library"] = values["library"] or None
    known = BeforeValidator(lambda given: with_known_keys(given, keys))
    try:
        return TypeAdapter(Annotated[Settings, known]).validate_python(values)
    except ValidationError as error:
        raise explain(error, Source("--set")) from None
