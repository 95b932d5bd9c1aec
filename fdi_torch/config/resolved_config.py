"""Resolution of run, monitor and rehearsal files: values are validated, and the plant is loaded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import Field, field_validator

from fdi_torch.config.key_reference import meanings
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import ConfigError, Source, naming_source, shown, validated
from fdi_torch.config.strict import Config, Strict, scaled_to_plant
from fdi_torch.config.yaml_files import expect_kind, find_file, find_plant, read_extended, with_overrides, write_yaml
from fdi_torch.effects import units_for_display
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import time_scale
from fdi_torch.quantities import display_in
from fdi_torch.recording import Recording

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


class JobConfig(Strict):
    """What run, monitor and rehearsal files have in common."""

    plant: Any = Field("three_tank", description="a shipped plant, a plant file, or the plant itself")
    output: OutputConfig = Field(default_factory=OutputConfig)
    seed: int = Field(0, ge=0, description="seed of all random numbers")


AnyConfig = TypeVar("AnyConfig", bound=JobConfig)


@dataclass(frozen=True)
class ResolvedFile(Generic[AnyConfig]):
    """A run, monitor or rehearsal file with its plant.

    base: folder of relative paths. source: the file and the overrides of its values. text: YAML of the same
    configuration, including the plant.
    """

    config: AnyConfig
    plant: PlantDescription
    base: Path
    source: Source
    text: str

    @property
    def name(self) -> str:
        return self.config.output.name or Path(self.source.file).stem

    @property
    def resolved(self) -> dict[str, Any]:
        """All values, including defaults, as plain nested values."""
        return self.config.model_dump(mode="json") | {"plant": plant_mapping(self.plant)}

    def log_records(self, data: Iterable[Mapping[str, str]] = ()) -> dict[str, Any]:
        """Configuration, seed and the origin of the data, as arguments of `RunLog`."""
        seeds = {"seed": self.config.seed}
        return {"config_text": self.text, "config": self.resolved, "seeds": seeds, "data": list(data)}


def values_in(path: str | Path, overrides: Iterable[str], kind: str) -> tuple[dict[str, Any], Path, Source]:
    """The mapping of a file of that kind with overrides, the file's folder, and both. Raises ConfigError."""
    file = find_file(str(path), Path.cwd())
    data = read_extended(file)
    expect_kind(data, kind, file)
    source = Source(str(file), tuple(overrides))
    return with_overrides(data, source.overrides), file.parent, source


def resolve(
    model: type[Config], data: Mapping[str, Any], base: Path, source: Source
) -> tuple[Config, PlantDescription, str]:
    """The validated configuration, its plant, and YAML of the same configuration including the plant.

    From now on quantities are displayed in the plant's units. base: folder of relative paths. Raises ConfigError with
    one sentence per problem.
    """
    config = validated(model, dict(data), source, meanings(model))
    plant = plant_of(data.get("plant", model.model_fields["plant"].default), base, source)
    config = scaled_to_plant(config, time_scale(plant))
    display_in(units_for_display(plant))
    written = {key: _written(value) for key, value in data.items()} | {"plant": plant_mapping(plant)}
    return config, plant, write_yaml(written)


def _written(value: Any) -> Any:
    """A value as YAML holds it: a recording in memory by its name."""
    if isinstance(value, Recording):
        return {"file": value.source}
    return [_written(each) for each in value] if isinstance(value, list | tuple) else value


def plant_of(entry: Any, base: Path, source: Source) -> PlantDescription:
    """The plant of an entry: a shipped name, a plant file, its mapping or the plant itself. Raises ConfigError."""
    if isinstance(entry, PlantDescription):
        return entry
    if isinstance(entry, str | Path):
        with naming_source(source):
            file = find_plant(str(entry), base)
        return load_plant(file)
    if isinstance(entry, dict):
        return build_plant({"name": "plant", **entry}, source.at("plant"))
    raise ConfigError([f"{source.at('plant')}: expected a shipped plant, a plant file or a plant, got {shown(entry)}"])
