"""What every reader of recordings is: a function from a file and the channels wanted of it to a Recording in SI."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from fdi_torch.recording import Hold, Recording


@dataclass(frozen=True)
class ChannelSource:
    """Where a channel's numbers come from, and what its cells mean.

    column: its header (the channel's own name where None), or its tag. unit: of the numbers in it (from the header
    where None). constant: the value (SI, in `unit`) of a channel that the file does not hold; NaN where it was never
    recorded. held: how long an input's value stands where cells after it are empty, s. words: what a cell with that
    text means, in `unit`; NaN: nothing was read. quality: header of the column that tells whether the value counts;
    good: the words by which it does. plus: headers of further columns whose values are added to it.
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
    """Where time stands. stamps: how time stamps are written (as for strptime; ISO 8601 where None). zone: in which
    their local time is, by its IANA name. shift: added to this clock, s. sort: rows may stand in any order.
    """

    stamps: str | None = None
    zone: str | None = None
    shift: float = 0.0
    sort: bool = False


@dataclass(frozen=True)
class TagRows:
    """Columns of a file with a row for each value: of the tag, of the value, and of its quality (or None)."""

    tag: str
    value: str
    quality: str | None = None


@dataclass(frozen=True)
class FileSource:
    """A file, what its columns are to channels (time is `t`), and how its rows are laid out (None: one an instant).

    header: whether its first row has the columns' names; else they are numbered from 1. sheet: of an Excel workbook.
    """

    path: Path
    columns: Mapping[str, ChannelSource] = field(default_factory=dict)
    tags: TagRows | None = None
    header: bool = True
    sheet: str | None = None


class Reader(Protocol):
    """The named channels of a file. In `mapping`, which says where those stand whose names do not tell, time is `t`.

    Raises ValueError, naming the file, for what is not in it or cannot be understood.
    """

    def __call__(
        self,
        path: Path,
        inputs: Sequence[str],
        outputs: Sequence[str],
        mapping: Mapping[str, ChannelSource] | None = None,
        hold: Hold = "zero_order",
    ) -> Recording: ...


def file_sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
