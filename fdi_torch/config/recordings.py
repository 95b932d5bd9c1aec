"""What a run file says of a recording: its files, their columns and clocks, and which of it counts."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo

from pydantic import AllowInfNan, BeforeValidator, Field, model_validator

from fdi_torch.config.strict import Amount, Seconds, Strict, quantity
from fdi_torch.outside import MOST_SAMPLES
from fdi_torch.recording import Recording
from fdi_torch.recordings.time_stamps import expect_zone

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


def _header(value: Any) -> Any:
    """A column's number stands for its header, in files without one."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Header = Annotated[str, BeforeValidator(_header)]


class ColumnConfig(Strict):
    column: Header | None = Field(
        None,
        description="header of the column, its number from 1 in a file without one, its tag where rows have tags, "
        "or TOPIC:FIELD of an MCAP file",
    )
    plus: list[Header] = Field(
        default_factory=list, description="further columns that are added to it, as of two pumps on one hose"
    )
    unit: str | None = Field(None, description="unit of its numbers, where the header does not end in it")
    constant: Amount | None = Field(None, description="the value of an input that was not recorded")
    recorded: bool = Field(True, description="false for an output that the file does not have")
    held: Annotated[float, AllowInfNan(True), BeforeValidator(_held)] = Field(
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
    file: str = Field(
        description="CSV (plain or .gz), MCAP, Parquet, Excel, MATLAB or HDF5 file; looked for here and below "
        "FDI_TORCH_DATA"
    )
    header: bool = Field(True, description="false: the columns have no names but numbers, {t: {column: 1, unit: s}}")
    sheet: str | None = Field(None, description="of an Excel workbook; by default the first")
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
    every: int = Field(1, ge=1, le=MOST_SAMPLES, description="use every n-th sample only")
    hold: Literal["zero_order", "linear"] = Field("zero_order", description="how inputs run between samples")
    trusted: bool = Field(
        False, description="units, channels and clocks are as they should be, whatever they look like: never refused"
    )
    start_levels: StartLevels = Field("free", description="free, equilibrium, or a mapping such as {T1: 50 cm}")
