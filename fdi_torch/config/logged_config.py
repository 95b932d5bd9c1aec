"""The configuration and the plant in a log. A log is untrusted: only plain YAML is read, and no file is opened."""

from __future__ import annotations

from typing import Any

from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.yaml_files import parse_yaml, shipped_plants
from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.names import unknown
from fdi_torch.plant.description import PlantDescription


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
