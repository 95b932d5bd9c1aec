"""Monitor files: the plant, the recording to follow, its fault-free part, and the faults to detect."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from fdi_torch.config.estimation import matching_names, names_in_full
from fdi_torch.config.live_source import SourceConfig
from fdi_torch.config.problems import Source, naming, naming_source
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.config.resolved_config import JobConfig, ResolvedFile, resolve, values_in
from fdi_torch.config.strict import ScaledSeconds, Seconds, Strict
from fdi_torch.monitor.monitor_settings import CONFIRM, LONGEST, LOOKBACK, MonitorSettings
from fdi_torch.plant.description import PlantDescription


class WindowConfig(Strict):
    """Default times are those of three_tank, and are multiplied by the time scale of the plant (`plant.scales`)."""

    lookback: ScaledSeconds = Field(LOOKBACK, description="length before an alarm in which its onset is searched, s")
    confirm: ScaledSeconds = Field(CONFIRM, description="time after an alarm until the fault is isolated, s")
    longest: ScaledSeconds = Field(LONGEST, description="maximum length of a window, s")
    stride: Seconds | None = Field(
        None, description="distance of windows that are fitted separately, s; by default longest"
    )
    incipient: bool = Field(True, description="whether faults may also grow slowly")
    together: int = Field(2, ge=1, description="maximum number of simultaneous faults")

    def settings(self) -> MonitorSettings:
        return MonitorSettings(**self.model_dump(exclude={"stride"}))


class MonitorConfig(JobConfig):
    recording: RecordingConfig = Field(description="the recording to follow; leave it out with `source`")
    source: SourceConfig | None = Field(None, description="a live source in place of a recording")
    fault_free: tuple[Seconds, Seconds] = Field(
        description="interval from which the noise is estimated, as in [0 s, 300 s]"
    )
    calibrate: list[str] = Field(
        default_factory=list,
        description="constants fitted to the fault-free part first, or patterns such as '*.discharge_coefficient'",
    )
    faults: list[str] = Field(
        default_factory=list,
        description="parameters that may change, or patterns such as '*.leak'; by default the usual ones",
    )
    ranges: dict[str, tuple[float, float]] = Field(
        default_factory=dict, description="ranges of faults that replace the default ones, SI"
    )
    mode: Literal["changes", "evolution", "least_squares"] = Field(
        "changes", description="isolate changes after alarms, or estimate all faults in each window by that method"
    )
    detector: Literal["fixed", "cusum"] = Field("cusum", description="detector that raises alarms")
    false_alarms_every: ScaledSeconds = Field(20000.0, description="mean time between false alarms, s")
    window: WindowConfig = Field(default_factory=WindowConfig)
    step: Seconds | None = Field(
        None, description="longest integration step, s; by default about a hundredth of the tanks' emptying time"
    )

    @model_validator(mode="before")
    @classmethod
    def _a_source_is_the_recording(cls, data: Any) -> Any:
        """Let `recording` describe a live source: its name, inputs and initial levels."""
        if not isinstance(data, dict) or not isinstance(source := data.get("source"), dict):
            return data
        if data.get("recording") is not None:
            raise ValueError("expected either recording or source, got both; leave one out")
        shared = {key: source[key] for key in ("hold", "start_levels") if key in source}
        without_credentials = re.sub(r"//[^/]*@", "//", str(source.get("url")))  # about which `source` itself complains
        return {**data, "recording": {"file": without_credentials, **shared}}


class MonitorRun(ResolvedFile[MonitorConfig]):
    """A resolved monitor file."""


def load_monitor(path: str | Path, overrides: Iterable[str] = ()) -> MonitorRun:
    """A monitor file with overrides. Raises ConfigError with one sentence per problem."""
    return build_monitor(*values_in(path, overrides, "monitor"))


def build_monitor(data: Mapping[str, Any], base: Path, source: Source) -> MonitorRun:
    """A monitor run from the mapping of a monitor file; base: folder of relative paths.

    A `Plant` or a `Recording` object may replace the name of the plant or of the recording's file.
    """
    config, plant, text = resolve(MonitorConfig, data, base, source)
    with naming_source(source):
        config = _in_full(config, plant)
    return MonitorRun(config, plant, base, source, text)


def _in_full(config: MonitorConfig, plant: PlantDescription) -> MonitorConfig:
    """Expand names: 'T1.leak' means the leak's size, and a pattern such as '*.leak' all that it matches."""
    ranged = names_in_full(config.ranges, plant, "ranges")
    ranges = dict(zip(ranged, config.ranges.values(), strict=True))
    faults, calibrate = (_matched(getattr(config, field), plant, field) for field in ("faults", "calibrate"))
    return config.model_copy(update={"faults": faults, "calibrate": calibrate, "ranges": ranges})


def _matched(patterns: Iterable[str], plant: PlantDescription, field: str) -> list[str]:
    """The full names that the patterns match, each once."""
    with naming(field):
        matched = [full for pattern in patterns for full in matching_names(pattern, plant)]
    return names_in_full(dict.fromkeys(matched), plant, field)
