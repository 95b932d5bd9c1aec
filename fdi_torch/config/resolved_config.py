"""Resolution of run, monitor and rehearsal files: values are validated, and the plant is loaded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from pydantic import Field, ValidationError, field_validator

from fdi_torch.config.key_reference import meanings
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import ConfigError, explain, shown
from fdi_torch.config.strict import Config, Strict, scaled_to_plant
from fdi_torch.config.yaml_files import expect_kind, find_file, read_extended, with_overrides, write_yaml
from fdi_torch.effects import units_for_display
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.quantities import display_in

LONGEST_NAME = 200


class OutputConfig(Strict):
    folder: str = Field("logs", description="for the log and the pictures")
    name: str = Field("", description="name of the run and its log, without ending; by default the run file's name")

    @field_validator("name")
    @classmethod
    def _stays_in_its_folder(cls, name: str) -> str:
        if name != Path(name).name or name == ".." or not name.isprintable() or len(name) > LONGEST_NAME:
            raise ValueError(f"expected a file's name without folders, got '{name}'; output.folder says where it goes")
        return name


class _WithOutput(Protocol):
    """What the models of run, monitor and rehearsal files share."""

    @property
    def output(self) -> OutputConfig: ...

    @property
    def seed(self) -> int: ...

    def model_dump(self, *, mode: str) -> dict[str, Any]: ...


AnyConfig = TypeVar("AnyConfig", bound=_WithOutput)


@dataclass(frozen=True)
class ResolvedFile(Generic[AnyConfig]):
    """A run, monitor or rehearsal file with its plant.

    base: folder of relative paths. source: the file's path. text: YAML of the same configuration, including the plant.
    """

    config: AnyConfig
    plant: PlantDescription
    base: Path
    source: str
    text: str

    @property
    def name(self) -> str:
        return self.config.output.name or Path(self.source).stem

    @property
    def resolved(self) -> dict[str, Any]:
        """All values, including defaults, as plain nested values."""
        return self.config.model_dump(mode="json") | {"plant": plant_mapping(self.plant)}

    def log_records(self, data: Iterable[Mapping[str, str]] = ()) -> dict[str, Any]:
        """Configuration, seed and the origin of the data, as arguments of `RunLog`."""
        seeds = {"seed": self.config.seed}
        return {"config_text": self.text, "config": self.resolved, "seeds": seeds, "data": list(data)}


def values_in(path: str | Path, overrides: Iterable[str], kind: str) -> tuple[dict[str, Any], Path]:
    """The mapping of a file of that kind with overrides, and the file's path. Raises ConfigError."""
    file = find_file(str(path), Path.cwd())
    data = read_extended(file)
    expect_kind(data, kind, file)
    return with_overrides(data, overrides), file


def resolve(
    model: type[Config], data: Mapping[str, Any], base: Path, source: str
) -> tuple[Config, PlantDescription, str]:
    """The validated configuration, its plant, and YAML of the same configuration including the plant.

    From now on quantities are displayed in the plant's units. base: folder of relative paths. Raises ConfigError with
    one sentence per problem.
    """
    try:
        config = model.model_validate(dict(data))
    except ValidationError as error:
        raise explain(error, source, meanings(model)) from None
    try:
        plant = plant_of(data.get("plant", model.model_fields["plant"].default), base, source)
    except ConfigError as error:  # errors within a plant file already name that file
        raise ConfigError([f"{source}: {p}" if p.startswith("plant: ") else p for p in error.problems]) from None
    config = scaled_to_plant(config, time_scale(plant))
    display_in(units_for_display(plant))
    return config, plant, write_yaml({**data, "plant": plant_mapping(plant)})


def plant_of(entry: Any, base: Path, source: str) -> PlantDescription:
    """The plant of an entry: a shipped name, a plant file, its mapping or the plant itself. Raises ConfigError."""
    if isinstance(entry, PlantDescription):
        return entry
    if isinstance(entry, str | Path):
        return load_plant(entry, base)
    if isinstance(entry, dict):
        return build_plant({"name": "plant", **entry}, f"{source}: plant")
    raise ConfigError([f"{source}: plant: expected a shipped plant, a plant file or a plant, got {shown(entry)}"])
