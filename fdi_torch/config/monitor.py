"""Monitor files: the plant, the recording to follow, its fault-free part, the faults to watch for and how."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from fdi_torch.config.estimation import names_in_full
from fdi_torch.config.loaded_recordings import named_apart
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.config.problems import told_in
from fdi_torch.config.recordings import RecordingConfig
from fdi_torch.config.run import OutputConfig
from fdi_torch.config.strict import BenchSeconds, Seconds, Strict
from fdi_torch.config.understood import understood, values_in
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monitor_setup import GainSpecification
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording


class WindowConfig(Strict):
    """Times that are not given are those of a bench, by ten longer or shorter for other plants (`plant.scales`)."""

    lookback: BenchSeconds = Field(300.0, description="how far before an alarm a change is sought, s")
    confirm: BenchSeconds = Field(60.0, description="how long after an alarm the faults are told apart, s")
    longest: BenchSeconds = Field(1000.0, description="no window reaches further back, s")
    stride: Seconds | None = Field(
        None, description="between windows that are fitted one by one, s; by default longest"
    )
    incipient: bool = Field(True, description="whether faults may also grow slowly")
    together: int = Field(2, ge=1, description="how many faults may come at once")

    def settings(self) -> MonitorSettings:
        return MonitorSettings(
            lookback=self.lookback,
            confirm=self.confirm,
            longest=self.longest,
            incipient=self.incipient,
            together=self.together,
        )


class ObserverConfig(Strict):
    time_constant: Seconds | None = Field(None, description="with which its slowest error decays, s")
    gain: list[list[float]] | None = Field(
        None, description="by hand: rows of tanks, columns of sensors, m per unit of the reading and sample"
    )

    def wish(self) -> GainSpecification | None:
        if self.time_constant is None and self.gain is None:
            return None
        return GainSpecification(self.time_constant, tuple(tuple(row) for row in self.gain or ()))


class MonitorConfig(Strict):
    plant: Any = Field("three_tank", description="a shipped plant, a plant file, or the plant itself")
    recording: RecordingConfig = Field(description="what is followed")
    fault_free: tuple[Seconds, Seconds] = Field(description="the part of it that noise is learnt from, s")
    calibrate: list[str] = Field(default_factory=list, description="constants fitted to the fault-free part first")
    faults: list[str] = Field(default_factory=list, description="parameters that may change; by default the usual ones")
    ranges: dict[str, tuple[float, float]] = Field(
        default_factory=dict, description="of faults whose usual range does not suit, SI"
    )
    mode: Literal["changes", "hybrid", "evolution", "least_squares", "multi_start"] = Field(
        "changes", description="single changes after alarms, or all faults window after window by that estimator"
    )
    detector: Literal["fixed", "cusum", "glr"] = Field("cusum", description="what raises alarms")
    false_alarms_every: BenchSeconds = Field(20000.0, description="mean time between false alarms, s")
    window: WindowConfig = Field(default_factory=WindowConfig)
    observer: ObserverConfig = Field(default_factory=ObserverConfig, description="by default by the noise")
    step: BenchSeconds = Field(1.0, description="longest integration step, s")
    output: OutputConfig = Field(default_factory=OutputConfig)
    seed: int = Field(0, ge=0, description="of the simulation that sets the threshold of the GLR")


@dataclass(frozen=True)
class MonitorRun:
    """A monitor file understood. base: where its paths start. text: YAML that gives the same run, plant included.
    given: recordings that are at hand, by what `file` calls them.
    """

    config: MonitorConfig
    plant: PlantDescription
    base: Path
    source: str
    text: str
    given: Mapping[str, Recording] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.config.output.name or Path(self.source).stem

    @property
    def resolved(self) -> dict[str, Any]:
        """Every value, defaults included, as plain nested values."""
        return self.config.model_dump(mode="json") | {"plant": plant_mapping(self.plant)}


def load_monitor(path: str | Path, overrides: Iterable[str] = ()) -> MonitorRun:
    """A monitor file with some values changed. Raises ConfigError with one sentence for each thing that is wrong."""
    data, file = values_in(path, overrides)
    return build_monitor(data, file.parent, str(file))


def build_monitor(data: Mapping[str, Any], base: Path, source: str) -> MonitorRun:
    """A monitor from a mapping as in a monitor file. `base` is where its paths start.

    In place of the name of the plant or of the recording's file may stand the `Plant` or the `Recording` itself.
    """
    (listed, *_), given = named_apart([data.get("recording")])
    config, plant, text = understood(MonitorConfig, {**data, "recording": listed} if given else data, base, source)
    with told_in(source):
        config = _in_full(config, plant)
    return MonitorRun(config, plant, base, source, text, given)


def _in_full(config: MonitorConfig, plant: PlantDescription) -> MonitorConfig:
    """'T1.leak' stands for the leak's size."""
    ranged = names_in_full(config.ranges, plant, "ranges")
    ranges = dict(zip(ranged, config.ranges.values(), strict=True))
    faults = names_in_full(config.faults, plant, "faults")
    names_in_full(config.calibrate, plant, "calibrate")
    return config.model_copy(update={"faults": faults, "ranges": ranges})
