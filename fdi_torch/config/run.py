"""Run files: which plant, which recordings (or a simulation), what to estimate and how, and where the results go."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from fdi_torch.config.estimation import EstimationConfig
from fdi_torch.config.files import DEFAULT_RUN
from fdi_torch.config.loaded_recordings import named_apart
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.recordings import RecordingConfig
from fdi_torch.config.simulation import SimulationConfig
from fdi_torch.config.strict import Strict
from fdi_torch.config.understood import understood, values_in
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

LONGEST_NAME = 200


class OutputConfig(Strict):
    folder: str = Field("logs", description="for the log and the pictures")
    name: str = Field("", description="of the run, a file's name without ending; by default that of its file")

    @field_validator("name")
    @classmethod
    def _stays_in_its_folder(cls, name: str) -> str:
        if name != Path(name).name or name == ".." or not name.isprintable() or len(name) > LONGEST_NAME:
            raise ValueError(f"expected a file's name without folders, got '{name}'; output.folder says where it goes")
        return name


class RunConfig(Strict):
    plant: Any = Field("three_tank", description="a shipped plant, a plant file, or the plant itself")
    recordings: list[RecordingConfig] = Field(default_factory=list, description="real data")
    simulate: SimulationConfig | None = Field(None, description="or a run to be simulated")
    estimate: EstimationConfig = Field(default_factory=EstimationConfig)
    output: OutputConfig = Field(default_factory=OutputConfig)
    seed: int = Field(0, ge=0, description="of everything drawn at random")
    device: str = Field("cpu", pattern=r"^(cpu|cuda(:\d{1,2})?)$", description="cpu or cuda")
    engine: Literal["auto", "reference", "compiled"] = Field("auto", description="what integrates")

    @model_validator(mode="after")
    def _one_source(self) -> RunConfig:
        if bool(self.recordings) == (self.simulate is not None):
            got = "both" if self.recordings else "neither"
            raise ValueError(f"expected either recordings or simulate, got {got}; keep one")
        return self


@dataclass(frozen=True)
class Run:
    """A run file understood. base: where its paths start. text: YAML that gives the same run, plant included.
    given: recordings that are at hand, by what `file` calls them.
    """

    config: RunConfig
    plant: PlantDescription
    base: Path
    source: str
    text: str
    given: Mapping[str, Recording] = field(default_factory=dict)

    @property
    def resolved(self) -> dict[str, Any]:
        """Every value, defaults included, as plain nested values."""
        return self.config.model_dump(mode="json") | {"plant": plant_mapping(self.plant)}

    @property
    def name(self) -> str:
        return self.config.output.name or Path(self.source).stem


def load_run(path: str | Path | None = None, overrides: Iterable[str] = ()) -> Run:
    """A run file, or the built-in default, with some values changed ('estimate.search.population=40').

    Raises ConfigError with one sentence for each thing that is wrong.
    """
    data, file = values_in(DEFAULT_RUN if path is None else path, overrides)
    return build_run(data, file.parent, str(file))


def build_run(data: Mapping[str, Any], base: Path, source: str) -> Run:
    """A run from a mapping as in a run file. `base` is where its paths start.

    In place of the name of a plant or of a recording's file may stand the `Plant` or the `Recording` itself.
    """
    recordings = data.get("recordings")
    listed, given = named_apart(recordings) if isinstance(recordings, list | tuple) else (recordings, {})
    config, plant, text = understood(RunConfig, {**data, "recordings": listed} if given else data, base, source)
    return Run(config, plant, base, source, text, given)
