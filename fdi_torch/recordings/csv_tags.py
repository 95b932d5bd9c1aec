"""CSV files with a row for each value, as historians export them: tag, time, value and often a quality."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_torch.parameters import si_unit_of, unit_factor
from fdi_torch.recordings.csv_binding import Bound, bind_clock, column_of, rule_of
from fdi_torch.recordings.csv_cells import number_in, ruled
from fdi_torch.recordings.csv_text import heading_of, open_csv, rows_of
from fdi_torch.recordings.source import ChannelSource, ClockSource, FileSource
from fdi_torch.recordings.stamps import stamp_reader

Tagged = tuple[Bound, np.ndarray, np.ndarray, np.ndarray]
"""A channel, and of each of its rows the number in the file, the time in the clock's unit, and the value."""


@dataclass
class _Rows:
    number: list[int] = field(default_factory=list)
    time: list[float] = field(default_factory=list)
    value: list[float] = field(default_factory=list)


def read_tags(file: FileSource, names: Sequence[str]) -> tuple[Bound, list[Tagged]]:
    """The clock, and each channel's rows in the order of the file.

    Raises ValueError, naming file and row, for a tag that is not there, a channel without a unit, a wrong cell.
    """
    path, tags = file.path, file.tags
    if tags is None:
        raise ValueError(f"{path}: expected a file with a row for each value, got none")
    sources = {name: file.columns.get(name, ChannelSource()) for name in names}
    wanted = {source.column or name: name for name, source in sources.items()}
    rows = {name: _Rows() for name in names}
    seen: set[str] = set()
    for channel, source in sources.items():
        if source.plus:
            raise ValueError(f"{path}: columns.{channel}.plus: expected no such key where rows have tags; leave it out")
    with open_csv(path, file.sheet) as handle:
        heading, lines = heading_of(path, handle)
        given = file.columns.get("t")
        clock = bind_clock(path, heading.names, given)
        when = heading.names.index(clock.header)
        tag, value = (heading.names.index(column_of(path, heading.names, c)) for c in (tags.tag, tags.value))
        quality = None if tags.quality is None else heading.names.index(column_of(path, heading.names, tags.quality))
        rules = {name: rule_of(source, quality) for name, source in sources.items()}
        read = stamp_reader(given.stamps, given.zone) if isinstance(given, ClockSource) else stamp_reader(None, None)
        for number, cells in rows_of(path, lines, heading.delimiter, heading.lines):
            if len(cells) != len(heading.names):
                if not any(cell.strip() for cell in cells):
                    continue
                raise ValueError(f"{path}: row {number}: expected {len(heading.names)} cells, got {len(cells)}")
            name = wanted.get(cells[tag].strip())
            if name is None:
                seen.add(cells[tag].strip())
                continue
            try:
                at = read(cells[when]) if clock.stamps else number_in(cells[when], heading.delimiter)
                flag = None if quality is None else cells[quality]
                found = ruled(cells[value], flag, rules[name], heading.delimiter)
            except ValueError as error:
                raise ValueError(f"{path}: row {number} ({cells[tag].strip()}): {error}") from None
            rows[name].number.append(number)
            rows[name].time.append(at)
            rows[name].value.append(found)
    return clock, [_tagged(path, name, sources[name], rows[name], seen) for name in names]


def _tagged(path: Path, name: str, source: ChannelSource, rows: _Rows, others: set[str]) -> Tagged:
    tag = source.column or name
    if not rows.time:
        near = difflib.get_close_matches(tag, sorted(others), n=1, cutoff=0.5)
        known = ", ".join(sorted(others)[:12]) or "none"
        hint = f"; the nearest is {near[0]}" if near else ""
        raise ValueError(
            f"{path}: expected rows of the tag {tag} for {name}, got {known}{hint}; "
            f"name it under columns: {{{name}: {{column: ..., unit: ...}}}}"
        )
    if source.unit is None:
        raise ValueError(
            f"{path}: {name}: expected the unit of {tag}, got none; give it under columns: {{{name}: {{unit: ...}}}}"
        )
    try:
        si_unit = si_unit_of(source.unit)
    except ValueError as error:
        raise ValueError(f"{path}: {name}: {error}") from error
    bound = Bound(name, tag, 0, unit_factor(source.unit, si_unit), si_unit)
    return bound, np.array(rows.number), np.array(rows.time), np.array(rows.value)
