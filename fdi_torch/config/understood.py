"""What run, monitor and rehearsal files have in common: their values are checked, and their plant is found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fdi_torch.config.files import find_file, read_extended, with_overrides, write_yaml
from fdi_torch.config.plant import build_plant, load_plant
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import ConfigError, explain
from fdi_torch.config.reference import keys
from fdi_torch.config.strict import Config, at_pace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale


def values_in(path: str | Path, overrides: Iterable[str] = ()) -> tuple[dict[str, Any], Path]:
    """What a file says, with some values changed, and where it lies. Raises ConfigError."""
    file = find_file(str(path), Path.cwd())
    return with_overrides(read_extended(file), overrides), file


def understood(
    model: type[Config], data: Mapping[str, Any], base: Path, source: str
) -> tuple[Config, PlantDescription, str]:
    """The values by that model, the plant they name or hold, and YAML that gives the same.

    base: where paths start. Raises ConfigError with one sentence for each thing that is wrong.
    """
    try:
        config = model.model_validate(dict(data))
    except ValidationError as error:
        raise explain(error, source, (path for path, _, _ in keys(model))) from None
    try:
        plant = plant_of(data.get("plant", model.model_fields["plant"].default), base, source)
    except ConfigError as error:  # a plant's own file is named already
        raise ConfigError([f"{source}: {p}" if p.startswith("plant: ") else p for p in error.problems]) from error
    config = at_pace(config, time_scale(plant))
    return config, plant, write_yaml({**data, "plant": plant_mapping(plant)})


def plant_of(wanted: Any, base: Path, source: str) -> PlantDescription:
    """The plant of that name, in that file, or that is written there itself. Raises ConfigError."""
    if isinstance(wanted, PlantDescription):
        return wanted
    if isinstance(wanted, str | Path):
        return load_plant(wanted, base)
    if isinstance(wanted, dict):
        return build_plant({"name": "plant", **wanted}, f"{source}: plant")
    raise ConfigError([f"{source}: plant: expected a shipped plant, a plant file or a plant, got {wanted!r}"])
