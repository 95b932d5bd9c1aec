"""The entry of a recording in a run file: its files, their columns and clocks, and the part to use."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import datetime, timedelta, timezone
from pathlib import PurePath
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo

from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr, model_validator

from fdi_torch.config.problems import Source, shown, validated
from fdi_torch.config.strict import Amount, HeldFor, Seconds, Strict, quantity
from fdi_torch.recording import Recording
from fdi_torch.recordings.database import expect_no_password, is_query
from fdi_torch.recordings.time_stamps import expect_zone
from fdi_torch.untrusted_input import MOST_SAMPLES

StartLevel = Literal["free", "equilibrium"] | float
"""A tank's initial level: to be estimated, the equilibrium of the first inputs, or a value in m."""


def _start_level(value: Any) -> StartLevel:
    if value in ("free", "equilibrium"):
        return value
    try:
        return quantity(value, "m")
    except ValueError:
        raise ValueError(f"expected free, equilibrium or a level such as '50 cm', got {shown(value)}") from None


def _start_levels(value: Any) -> Any:
    """free, equilibrium, or a mapping of tanks to these or to levels."""
    if isinstance(value, dict):
        return {str(tank): _start_level(level) for tank, level in value.items()}
    return _start_level(value)


StartLevels = Annotated[Any, BeforeValidator(_start_levels)]


def _words(value: Any) -> Any:
    """The meaning of words by their text; YAML reads -9999 as a number and off as a truth value."""
    if not isinstance(value, dict):
        return value
    texts = {True: "on", False: "off"}
    return {texts[k] if isinstance(k, bool) else str(k): v for k, v in value.items()}


def _zone(value: Any) -> Any:
    expect_zone(str(value))
    return value


def _header(value: Any) -> Any:
    """The number of a column is its header in files without one."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Header = Annotated[str, BeforeValidator(_header)]


class ColumnConfig(Strict):
    column: Header | None = Field(
        None,
        description="header of the column, its number from 1 in a file without one, its tag where rows have tags, "
        "or TOPIC:FIELD of an MCAP file",
    )
    plus: list[Header] = Field(
        default_factory=list, description="further columns that are added, for example of two pumps on one hose"
    )
    unit: str | None = Field(None, description="unit of its numbers, if the header does not end in it")
    constant: Amount | None = Field(None, description="the value of an input that was not recorded")
    recorded: bool = Field(True, description="false for an output that is missing in the file")
    held: HeldFor = Field(
        0.0,
        description="time for which an input is held over empty cells and missing rows: 15 s, or always (until the "
        "next value)",
    )
    words: Annotated[dict[str, Amount | None], BeforeValidator(_words)] = Field(
        default_factory=dict, description="meaning of words: {OPEN: 1, CLOSED: 0, -9999: null}; null: a bad reading"
    )
    quality: str | None = Field(None, description="header of the column that says whether the value counts")
    good: list[str | int] = Field(default_factory=list, description="its words for valid; by default good, ok, 192 ...")
    stamps: str | None = Field(None, description="for the time t: format of time stamps, as in '%d/%m/%Y %H:%M:%S'")
    zone: Annotated[str | None, BeforeValidator(_zone)] = Field(
        None, description="for the time t: time zone of local time, as in Europe/Berlin; by default UTC"
    )
    shift: Seconds = Field(0.0, description="for the time t: correction that is added to the times of this file, s")
    sort: bool = Field(False, description="for the time t: true if the rows are not in the order of time")
    period: Seconds | None = Field(
        None, gt=0, description="for the time t: time from row to row, such as 50 ms, of a file without a time column"
    )


class TagsConfig(Strict):
    tag: str = Field(description="header of the column with the tag, which is a channel's `column`")
    value: str = Field(description="header of the column with the value")
    quality: str | None = Field(None, description="header of the column that says whether the value counts")


def _name(value: str) -> str:
    if is_query(value):
        expect_no_password(value)
    return value


class FileConfig(Strict):
    file: Annotated[str, AfterValidator(_name)] = Field(
        description="CSV (plain or .gz), MCAP, Parquet, Feather, Excel, MATLAB or HDF5 file; looked for here and below "
        "FDI_TORCH_DATA; or a database query, DATABASE?query=SQL"
    )
    header: bool = Field(True, description="false: columns have numbers instead of names, {t: {column: 1, unit: s}}")
    sheet: str | None = Field(None, description="of an Excel workbook; by default the first")
    columns: dict[str, ColumnConfig] = Field(
        default_factory=dict, description="for channels (time is t) whose header is not name_unit"
    )
    tags: TagsConfig | None = Field(None, description="for a CSV file with one row per value")

    @model_validator(mode="before")
    @classmethod
    def _a_name_alone_is_the_file(cls, data: Any) -> Any:
        if isinstance(data, str):
            return {"file": data}
        if not isinstance(data, Mapping | FileConfig):
            raise ValueError(
                "expected a file name, its keys such as {file: run.csv}, or in Python a Recording (of a data frame: "
                f"fdi_torch.read_frame), got a {type(data).__name__}"
            )
        return data


def _moment(value: Any) -> float | datetime:
    """Seconds of the recording's clock, or a time stamp (which YAML may already have parsed)."""
    if isinstance(value, str) and _STAMP.match(value):
        return datetime.fromisoformat(value)
    return value if isinstance(value, datetime) else quantity(value, "s")


_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d", re.ASCII)
Moment = Annotated[float | datetime, BeforeValidator(_moment)]


def in_seconds(moment: float | datetime, recording: Recording, config: RecordingConfig) -> float:
    """Time on the recording's clock, s. A stamp without offset is in the zone of `t`, or else in that of the file.

    Raises ValueError if the clock has no date.
    """
    if not isinstance(moment, datetime):
        return moment
    if recording.began is None:
        raise ValueError(f"{config.file}: expected a time in s as in '300 s', got {moment}: its clock has no date")
    zone = config.columns["t"].zone if "t" in config.columns else None
    of_file = ZoneInfo(zone) if zone else timezone(timedelta(seconds=recording.zone))
    local = moment if moment.tzinfo else moment.replace(tzinfo=of_file)
    return local.timestamp() - recording.began


class RecordingConfig(FileConfig):
    also: list[FileConfig] = Field(default_factory=list, description="CSV files with further channels of the same run")
    start: Moment | None = Field(None, description="first time used, s, or a time stamp such as 2026-03-29 08:30:00")
    stop: Moment | None = Field(None, description="last time used, s, or a time stamp")
    mask: list[tuple[Moment, Moment]] = Field(
        default_factory=list, description="intervals whose readings are ignored, s or stamps"
    )
    every: int = Field(1, ge=1, le=MOST_SAMPLES, description="use every n-th sample only")
    hold: Literal["zero_order", "linear"] = Field("zero_order", description="course of inputs between samples")
    trusted: bool = Field(False, description="do not check for wrong units, swapped channels and clock errors")
    start_levels: StartLevels = Field("free", description="free, equilibrium, or a mapping such as {T1: 50 cm}")
    _in_memory: Recording | None = PrivateAttr(None)

    @model_validator(mode="wrap")
    @classmethod
    def _of_a_recording(cls, data: Any, validated: Callable[[Any], RecordingConfig]) -> RecordingConfig:
        """Accept a recording in memory in place of the name of its file."""
        config = validated({"file": data.source} if isinstance(data, Recording) else data)
        if isinstance(data, Recording):
            config._in_memory = data
        return config

    @property
    def in_memory(self) -> Recording | None:
        """The recording itself, if it was given in place of a file."""
        return self._in_memory


def config_of(entry: Any) -> RecordingConfig:
    """The entry of a recording from its file name alone, or from its keys. Raises ConfigError naming the key."""
    return validated(RecordingConfig, str(entry) if isinstance(entry, PurePath) else entry, Source("recording"))
