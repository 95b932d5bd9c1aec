"""Which recordings are meant, and reading them as the plant's inputs and outputs."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo

import torch
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from fdi_torch.config.files import find_data, find_file, read_extended
from fdi_torch.config.problems import ConfigError, explain
from fdi_torch.config.strict import Amount, Seconds, Strict, quantity
from fdi_torch.logbook import LogError
from fdi_torch.names import unknown
from fdi_torch.parameters import header_unit
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.csv_files import read_csv_files, read_header
from fdi_torch.recordings.mcap_files import read_mcap
from fdi_torch.recordings.source import ChannelSource, ClockSource, FileSource, TagRows
from fdi_torch.recordings.stamps import expect_zone

GIVE_A_CONSTANT = "give the unknown one a constant, as in columns: {Q1: {constant: 0 cm^3/s}}"

StartLevel = Literal["free", "equilibrium"] | float
"""How a tank's level at the start is known: to be estimated, at rest under the first inputs, or so many metres."""


def _start_level(value: Any) -> StartLevel:
    if value in ("free", "equilibrium"):
        return value
    try:
        return quantity(value, "m")
    except ValueError as error:
        raise ValueError(f"expected free, equilibrium or a level such as '50 cm', got {value!r}") from error


def _start_levels(value: Any) -> Any:
    """free, equilibrium, or a mapping of tanks to these or to levels."""
    if isinstance(value, dict):
        return {str(tank): _start_level(level) for tank, level in value.items()}
    return _start_level(value)


StartLevels = Annotated[Any, BeforeValidator(_start_levels)]


def _held(value: Any) -> float:
    return math.inf if value == "always" else quantity(value, "s")


def _words(value: Any) -> Any:
    """What words mean, by their text: YAML reads -9999 and off as a number and a truth."""
    if not isinstance(value, dict):
        return value
    texts = {True: "on", False: "off"}
    return {texts[k] if isinstance(k, bool) else str(k): v for k, v in value.items()}


def _zone(value: Any) -> Any:
    expect_zone(str(value))
    return value


class ColumnConfig(Strict):
    column: str | None = Field(
        None, description="header of the column, its tag where rows have tags, or TOPIC:FIELD of an MCAP file"
    )
    unit: str | None = Field(None, description="unit of its numbers, where the header does not end in it")
    constant: Amount | None = Field(None, description="the value of an input that was not recorded")
    recorded: bool = Field(True, description="false for an output that the file does not have")
    held: Annotated[float, BeforeValidator(_held)] = Field(
        0.0, description="for how long an input's value stands where cells are empty: 15 s, or always (until the next)"
    )
    words: Annotated[dict[str, Amount | None], BeforeValidator(_words)] = Field(
        default_factory=dict, description="what cells mean: {OPEN: 1, CLOSED: 0, -9999: null}; null: nothing was read"
    )
    quality: str | None = Field(None, description="header of the column that says whether the value counts")
    good: list[str | int] = Field(default_factory=list, description="what it then says; by default good, ok, 192 ...")
    stamps: str | None = Field(None, description="of t: how time stamps are written, as in '%d/%m/%Y %H:%M:%S'")
    zone: Annotated[str | None, BeforeValidator(_zone)] = Field(
        None, description="of t: where its local time is, as in Europe/Berlin; without it UTC"
    )
    shift: Seconds = Field(0.0, description="of t: added to this clock, s")
    sort: bool = Field(False, description="of t: rows may stand in any order")


class TagsConfig(Strict):
    tag: str = Field(description="header of the column with the tag, which is a channel's `column`")
    value: str = Field(description="header of the column with the value")
    quality: str | None = Field(None, description="header of the column that says whether the value counts")


class FileConfig(Strict):
    file: str = Field(description="CSV (plain or .gz) or MCAP file; looked for here and below FDI_TORCH_DATA")
    columns: dict[str, ColumnConfig] = Field(
        default_factory=dict, description="for channels (time is t) whose header is not name_unit"
    )
    tags: TagsConfig | None = Field(None, description="for a CSV file with a row for each value")

    @model_validator(mode="before")
    @classmethod
    def _a_name_alone_is_the_file(cls, data: Any) -> Any:
        return {"file": data} if isinstance(data, str) else data


def _moment(value: Any) -> float | datetime:
    """Seconds of the recording's clock, or a time stamp, which YAML may have read as one."""
    if isinstance(value, str) and _STAMP.match(value):
        return datetime.fromisoformat(value)
    return value if isinstance(value, datetime) else quantity(value, "s")


_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d")
Moment = Annotated[float | datetime, BeforeValidator(_moment)]


def in_seconds(moment: float | datetime, recording: Recording, config: RecordingConfig) -> float:
    """On the recording's clock. A stamp without offset is in the zone of `t`, as the file's own are, or else UTC.

    Raises ValueError where the clock does not tell the date.
    """
    if not isinstance(moment, datetime):
        return moment
    if recording.began is None:
        raise ValueError(f"{config.file}: expected a moment in s as in '300 s', got {moment}: its clock tells no date")
    zone = config.columns["t"].zone if "t" in config.columns else None
    local = moment if moment.tzinfo else moment.replace(tzinfo=ZoneInfo(zone) if zone else UTC)
    return local.timestamp() - recording.began


class RecordingConfig(FileConfig):
    also: list[FileConfig] = Field(default_factory=list, description="CSV files with further channels of the same run")
    start: Moment | None = Field(None, description="first time used, s, or a stamp such as 2026-03-29 08:30:00")
    stop: Moment | None = Field(None, description="last time used, s, or a stamp")
    mask: list[tuple[Moment, Moment]] = Field(
        default_factory=list, description="intervals whose readings do not count, s or stamps"
    )
    every: int = Field(1, ge=1, description="use every n-th sample only")
    hold: Literal["zero_order", "linear"] = Field("zero_order", description="how inputs run between samples")
    start_levels: StartLevels = Field("free", description="free, equilibrium, or a mapping such as {T1: 50 cm}")


@dataclass(frozen=True)
class LoadedRecording:
    """A stretch of a recording whose inputs are all known, and what is known of each tank's level at its start."""

    recording: Recording
    start_levels: dict[str, StartLevel]


def load_recordings(
    configs: Sequence[RecordingConfig], plant: PlantDescription, base: Path | None = None
) -> list[LoadedRecording]:
    """Every recording, cut where an input is unknown."""
    return [part for config in configs for part in known_parts(read_recording(config, plant, base), config, plant)]


def known_parts(whole: Recording, config: RecordingConfig, plant: PlantDescription) -> list[LoadedRecording]:
    """A recording cut where an input is unknown; the levels at the start of a later stretch are free."""
    stretches = [part for part in whole.known_stretches() if len(part) > 1]
    if not stretches:
        raise ConfigError([f"{whole.source}: expected a stretch with all inputs known, got none: {_unknown(whole)}"])
    first = float(whole.time[0])
    starts = [config.start_levels if float(part.time[0]) == first else "free" for part in stretches]
    return [LoadedRecording(part, _levels(start, plant, config)) for part, start in zip(stretches, starts, strict=True)]


def _unknown(whole: Recording) -> str:
    """Which inputs are unknown and how often, and what to do about it."""
    shares = torch.isnan(whole.inputs).double().mean(dim=0).tolist()
    each = {name: share for name, share in zip(whole.input_names, shares, strict=True) if share > 0.0}
    told = ", ".join(f"{name} at {share:.3g} of the samples" for name, share in each.items())
    some = next((name for name, share in each.items() if share < 1.0), "")
    fix = f"where its last value stands for empty cells say for how long, as in columns: {{{some}: {{held: 10 s}}}}"
    return f"unknown are {told}; " + (f"{fix}, or {GIVE_A_CONSTANT}" if some else GIVE_A_CONSTANT)


def named_recordings(name: str, plant: PlantDescription, base: Path) -> list[Recording]:
    """What stands for recordings on a command line: a CSV or MCAP file, or a YAML file with a list under `recordings`,
    as in a run file; each in stretches whose inputs are known.
    """
    if Path(name).suffix not in (".yaml", ".yml"):
        return [part.recording for part in load_recordings([RecordingConfig(file=name)], plant, base)]
    path = find_file(name, base)
    listed = read_extended(path).get("recordings")
    if not listed:
        raise ConfigError([f"{path}: recordings: expected at least one, got none; list files under it"])
    try:
        configs = [RecordingConfig.model_validate(entry) for entry in listed]
    except ValidationError as error:
        raise explain(error, f"{path}: recordings") from None
    return [loaded.recording for loaded in load_recordings(configs, plant, path.parent)]


def read_recording(config: RecordingConfig, plant: PlantDescription, base: Path | None = None) -> Recording:
    """The plant's inputs and outputs: selected, masked and thinned, unknown inputs still in it (NaN)."""
    path = find_data(config.file, base or Path.cwd())
    channels, columns = plant.channels(), tuple(sensor.column for sensor in plant.sensors)
    try:
        recording = _read(config, path, base or Path.cwd(), plant, channels, columns)
        names = (*recording.input_names, *recording.output_names)
        expect_units(recording.source, names, (*recording.input_units, *recording.output_units), plant)
        start = -math.inf if config.start is None else in_seconds(config.start, recording, config)
        stop = math.inf if config.stop is None else in_seconds(config.stop, recording, config)
        masks = [(in_seconds(a, recording, config), in_seconds(b, recording, config)) for a, b in config.mask]
        return recording.window(start, stop).masked(masks).every(config.every)
    except (ValueError, LogError) as error:
        raise ConfigError([str(error)]) from error


def _read(
    config: RecordingConfig,
    path: Path,
    base: Path,
    plant: PlantDescription,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Recording:
    """By the file's ending: an MCAP log (also one that was cut off while written), or else CSV."""
    mapping = channel_mapping(config, plant)
    if _is_log(path):
        if config.also or config.tags:
            raise ValueError(f"{config.file}: expected neither also nor tags beside an MCAP file; leave them")
        return read_mcap(path, inputs, outputs, mapping, config.hold)
    files = [_source(config, path, mapping)]
    files += [_source(each, find_data(each.file, base), channel_mapping(each, plant)) for each in config.also]
    if not config.also and not config.tags:
        files = [FileSource(path, unrecorded_valves(path, plant) | mapping)]
    return read_csv_files(files, inputs, outputs, config.hold)


def _source(config: FileConfig, path: Path, mapping: Mapping[str, ChannelSource]) -> FileSource:
    if _is_log(path):
        raise ValueError(f"{config.file}: expected a CSV file beside others, got an MCAP file")
    tags = config.tags
    return FileSource(path, mapping, None if tags is None else TagRows(tags.tag, tags.value, tags.quality))


def _is_log(path: Path) -> bool:
    return ".mcap" in path.suffixes


def unrecorded_valves(path: Path, plant: PlantDescription) -> dict[str, ChannelSource]:
    """The valves that a CSV file lacks and the plant file says how they then stand."""
    known = {p.valve: p.unrecorded for p in plant.pipes if p.valve and p.unrecorded is not None}
    return {name: ChannelSource(None, "1", known[name]) for name in _lacking(path, known)}


def missing_inputs(path: Path, plant: PlantDescription) -> list[str]:
    """The plant's inputs that a CSV file has no column for, but valves of which the plant file says how they stand."""
    known = unrecorded_valves(path, plant)
    return [name for name in _lacking(path, plant.channels()) if name not in known]


def _lacking(path: Path, names: Collection[str]) -> list[str]:
    """Those of the names that no header of a CSV file is about; of other files none."""
    if not names or _is_log(path):
        return []
    header = read_header(path)
    there = {*header, *(split[0] for column in header if (split := header_unit(column)))}
    return [name for name in names if name not in there]


def channel_mapping(config: FileConfig, plant: PlantDescription) -> dict[str, ChannelSource]:
    units = _units(plant)
    mapping: dict[str, ChannelSource] = {}
    for name, column in config.columns.items():
        place = f"{config.file}: columns.{name}"
        if name != "t" and name not in units:
            raise ValueError(f"{place}: {unknown('a channel of the plant or t', name, [*units, 't'])}")
        _expect_keys_that_fit(place, name, column, plant)
        mapping[name] = _clock_source(column) if name == "t" else _channel_source(place, column, units[name])
    return mapping


def _expect_keys_that_fit(place: str, name: str, column: ColumnConfig, plant: PlantDescription) -> None:
    """Raises ValueError for a key that says nothing of that channel."""
    only_clock, only_input = ("stamps", "zone", "shift", "sort"), ("held",)
    only_channel = ("constant", "recorded", "held", "words", "quality", "good")
    unfit = only_channel if name == "t" else only_clock
    if name != "t" and name not in plant.channels():
        unfit = (*unfit, *only_input)
    for key in unfit:
        if key in column.model_fields_set:
            of = "a channel" if name == "t" else "an input" if key in only_input else "t"
            raise ValueError(f"{place}.{key}: expected this key of {of} only; leave it out")


def _clock_source(column: ColumnConfig) -> ClockSource:
    return ClockSource(
        column.column, column.unit, stamps=column.stamps, zone=column.zone, shift=column.shift, sort=column.sort
    )


def _channel_source(place: str, column: ColumnConfig, unit: str) -> ChannelSource:
    try:
        constant = None if column.constant is None else quantity(column.constant, unit)
    except ValueError as error:
        raise ValueError(f"{place}.constant: {error}") from error
    if not column.recorded:
        constant = float("nan")
    if constant is not None:
        return ChannelSource(column.column, unit, constant)
    words = {text: _meaning(f"{place}.words.{text}", value, column.unit) for text, value in column.words.items()}
    good = tuple(str(word) for word in column.good)
    return ChannelSource(column.column, column.unit, None, column.held, words, column.quality, good)


def _meaning(place: str, value: Amount | None, unit: str | None) -> float:
    """The number that a word stands for, in the unit of its column; NaN where nothing was read."""
    if isinstance(value, str):
        raise ValueError(f"{place}: expected a number in the unit of the column ({unit or 'see its header'}) or null")
    return float("nan") if value is None else float(value)


def _units(plant: PlantDescription) -> dict[str, str]:
    return plant.channel_units() | {sensor.column: sensor.unit for sensor in plant.sensors}


def expect_units(source: str, names: Sequence[str], units: Sequence[str], plant: PlantDescription) -> None:
    """Raises ValueError where a channel's unit (SI) is of another kind than the plant's."""
    expected = _units(plant)
    for name, unit in zip(names, units, strict=True):
        if unit != expected[name]:
            raise ValueError(
                f"{source}: {name}: expected a unit of the kind {expected[name]} (plant {plant.name}), "
                f"got one of the kind {unit}; correct the header, columns, or the gain in the plant file"
            )


def _levels(wanted: Any, plant: PlantDescription, config: RecordingConfig) -> dict[str, StartLevel]:
    tanks = [tank.name for tank in plant.tanks]
    if not isinstance(wanted, dict):
        return dict.fromkeys(tanks, wanted)
    for name in wanted:
        if name not in tanks:
            raise ConfigError([f"{config.file}: start_levels.{name}: {unknown('a tank', name, tanks)}"])
    return {tank: wanted.get(tank, "free") for tank in tanks}
