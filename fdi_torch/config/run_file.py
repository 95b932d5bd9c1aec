"""Run files: the plant, recordings or a simulation, what to estimate, and the place of the results."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from fdi_torch.config.estimation import EstimationConfig
from fdi_torch.config.problems import Source
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.config.resolved_config import JobConfig, ResolvedFile, resolve, values_in
from fdi_torch.config.simulation import SimulationConfig
from fdi_torch.config.yaml_files import DEFAULT_RUN
from fdi_torch.estimate.fitting import EngineKind
from fdi_torch.recording import Recording


class RunConfig(JobConfig):
    recordings: list[RecordingConfig] = Field(default_factory=list, description="recordings of the rig")
    simulate: SimulationConfig | None = Field(None, description="or a run to be simulated")
    estimate: EstimationConfig = Field(default_factory=EstimationConfig)
    device: str = Field("cpu", description="of the search and the refinement: cpu or cuda")
    engine: EngineKind = Field("auto", description="simulation engine; compiled only on the CPU")

    @field_validator("device")
    @classmethod
    def _known_device(cls, name: str) -> str:
        if not re.fullmatch(r"cpu|cuda(:\d{1,2})?", name):
            raise ValueError(f"expected cpu, cuda or a number of a GPU such as cuda:1, got '{name}'; correct it")
        return name

    @model_validator(mode="after")
    def _one_source(self) -> RunConfig:
        if bool(self.recordings) == (self.simulate is not None):
            got = "both; keep one" if self.recordings else "neither; add one"
            raise ValueError(f"expected either recordings or simulate, got {got}")
        return self


class Run(ResolvedFile[RunConfig]):
    """A resolved run file."""


def load_run(path: str | Path | None = None, overrides: Iterable[str] = ()) -> Run:
    """A run file, or the built-in default, with overrides ('estimate.search.population=40').

    Raises ConfigError with one sentence per problem.
    """
    return build_run(*values_in(DEFAULT_RUN if path is None else path, overrides, "run"))


def build_run(data: Mapping[str, Any], base: Path, source: Source) -> Run:
    """A run from the mapping of a run file; base: folder of relative paths.

    A `Plant` or a `Recording` object may replace the name of a plant or of a recording's file.
    """
    recordings = data.get("recordings")
    listed = {"recordings": [recordings]} if isinstance(recordings, Recording) else {}
    config, plant, text = resolve(RunConfig, {**data, **listed}, base, source)
    return Run(config, plant, base, source, text)
