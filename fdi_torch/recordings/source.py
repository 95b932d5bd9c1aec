"""Where a recording's channels come from, and the interface of all readers: file and channels -> Recording in SI."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class ChannelSource:
    """The source of a channel's numbers, and the meaning of its cells.

    column: its header or tag (default: the channel's name). unit: of its numbers (default: from the header). constant:
    value (in `unit`, SI) of a channel that the file lacks; NaN for unknown. held: how long an input keeps its value
    over empty cells, s. words: text of a cell -> value in `unit`, NaN for a bad reading. quality: header of the column
    with the quality of the value; good: its words for a valid value. plus: headers of columns that are added.
    """

    column: str | None = None
    unit: str | None = None
    constant: float | None = None
    held: float = 0.0
    words: Mapping[str, float] = field(default_factory=dict)
    quality: str | None = None
    good: tuple[str, ...] = ()
    plus: tuple[str, ...] = ()


@dataclass(frozen=True)
class ClockSource(ChannelSource):
    """The source of time.

    stamps: format of time stamps (as for strptime; default: ISO 8601). zone: IANA name of the zone of local time.
    shift: added to this clock, s. sort: whether rows may be in any order. period: time between rows, s, of a file
    without a column of time.
    """

    stamps: str | None = None
    zone: str | None = None
    shift: float = 0.0
    sort: bool = False
    period: float | None = None


def clock_in(columns: Mapping[str, ChannelSource]) -> ClockSource:
    """The source of time among the sources of channels, `t`."""
    source = columns.get("t", ClockSource())
    return source if isinstance(source, ClockSource) else ClockSource(**vars(source))


@dataclass(frozen=True)
class TagRows:
    """Column headers of a file with one row per value: tag, value, and quality (or None)."""

    tag: str
    value: str
    quality: str | None = None


@dataclass(frozen=True)
class FileSource:
    """A file, its columns by channel (time is `t`), and its layout. tags: None for one row per instant.

    header: whether its first row has the columns' names; otherwise columns are numbered from 1. sheet: of an Excel
    workbook.
    """

    path: Path
    columns: Mapping[str, ChannelSource] = field(default_factory=dict)
    tags: TagRows | None = None
    header: bool = True
    sheet: str | None = None


def file_sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
