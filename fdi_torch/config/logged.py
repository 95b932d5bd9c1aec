"""The configuration and the plant that a log holds. A log is untrusted: plain YAML only, of a limited size."""

from __future__ import annotations

from typing import Any

from fdi_torch.config.files import parse_yaml
from fdi_torch.config.plant import build_plant, load_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.plant.description import PlantDescription

MOST_BYTES = 2**20
MOST_VALUES = 100_000


def logged_mapping(log: LoggedRun) -> dict[str, Any]:
    """The configuration of a run as keys and values. Raises ConfigError where the log holds none."""
    if "config.yaml" not in log.attachments:
        raise ConfigError([f"{log.path}: expected a configuration in the log, got none; it cannot be run again"])
    raw = log.attachment("config.yaml")
    if len(raw) > MOST_BYTES:
        raise ConfigError([f"{log.path}: expected a configuration of at most {MOST_BYTES} bytes, got {len(raw)}"])
    data = parse_yaml(raw, f"{log.path}: config.yaml")
    if values_in(data, MOST_VALUES) > MOST_VALUES:
        raise ConfigError([f"{log.path}: config.yaml: expected at most {MOST_VALUES} values, got more"])
    return data


def logged_plant(log: LoggedRun) -> PlantDescription:
    """The plant of a run; the configuration may also be a plant itself, or name a shipped one."""
    data = logged_mapping(log)
    plant = data.get("plant", data)
    if isinstance(plant, str) and plant.isidentifier():  # a shipped one; a log opens no other files
        return load_plant(plant)
    if not isinstance(plant, dict):
        raise ConfigError([f"{log.path}: config.yaml: plant: expected a plant, got {type(plant).__name__}"])
    return build_plant({"name": "plant", **plant}, f"{log.path}: config.yaml")


def values_in(data: Any, most: int) -> int:
    """How many values a nested structure holds, counted up to `most` + 1: aliases make small files huge."""
    count, ahead = 0, [data]
    while ahead and count <= most:
        node = ahead.pop()
        count += 1
        ahead += [*node, *node.values()] if isinstance(node, dict) else node if isinstance(node, list) else []
    return count
