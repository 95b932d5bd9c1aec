"""CSV files with one row per value, as process historians export them: tag, time, value and often a quality."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fdi_torch.names import nearest
from fdi_torch.quantities import si_unit_of, unit_factor
from fdi_torch.recordings.csv_binding import Bound, bind_clock, column_of, rule_of
from fdi_torch.recordings.csv_cells import apply_rule, number_in
from fdi_torch.recordings.csv_text import heading_of, open_csv, rows_of
from fdi_torch.recordings.source import ChannelSource, FileSource, TagRows, clock_in
from fdi_torch.recordings.time_stamps import StampReader

TAG_NAMES = (
    *("tag", "tagname", "point", "pointname", "variable", "varname", "signal", "metric", "field", "item", "itemname"),
    "messstelle",
)
VALUE_NAMES = ("value", "datavalue", "tagvalue", "varvalue", "avgvalue", "average", "wert", "messwert")
QUALITY_NAMES = ("quality", "dataquality", "opcquality", "status", "validity")
"""Usual names of the columns of tags, values and their quality: lower case, letters only."""
Tagged = tuple[Bound, np.ndarray, np.ndarray, np.ndarray]
"""A channel, and for each of its rows the row number, the time in the clock's unit, and the value."""


def tag_columns(header: Sequence[str]) -> TagRows | None:
    """The columns of tag, value and quality in a header with the usual names; None for another table."""
    by_name = {"".join(re.findall(r"[^\W\d_]+", column.lower())): column for column in reversed(header)}
    tag, value, quality = (
        next((by_name[name] for name in names if name in by_name), None)
        for names in (TAG_NAMES, VALUE_NAMES, QUALITY_NAMES)
    )
    return TagRows(tag, value, quality) if tag and value else None


def read_tags(file: FileSource, names: Sequence[str]) -> tuple[Bound, list[Tagged], StampReader]:
    """The clock, the rows of each channel in the order of the file, and the reader of time stamps.

    Raises ValueError, naming file and row, for a missing tag, a channel without unit, or a malformed cell.
    """
    path, tags = file.path, file.tags
    if tags is None:
        raise ValueError(f"{path}: expected a file with a row for each value, got none")
    sources = {name: file.columns.get(name, ChannelSource()) for name in names}
    channel_by_tag = {source.column or name: name for name, source in sources.items()}
    rows: dict[str, list[tuple[int, float, float]]] = {name: [] for name in names}
    other_tags: set[str] = set()
    for channel, source in sources.items():
        if source.plus:
            raise ValueError(f"{path}: columns.{channel}.plus: expected no such key where rows have tags; leave it out")
    with open_csv(path, file.sheet) as handle:
        heading, lines = heading_of(path, handle)
        clock_source = clock_in(file.columns)
        clock = bind_clock(path, heading.names, clock_source)
        time_column = heading.names.index(clock.header)
        tag, value = (heading.names.index(column_of(path, heading.names, c)) for c in (tags.tag, tags.value))
        quality = None if tags.quality is None else heading.names.index(column_of(path, heading.names, tags.quality))
        rules = {name: rule_of(source, quality) for name, source in sources.items()}
        read = StampReader(clock_source.stamps, clock_source.zone)
        for number, cells in rows_of(path, lines, heading.delimiter, heading.lines):
            if len(cells) != len(heading.names):
                if not any(cell.strip() for cell in cells):
                    continue
                raise ValueError(f"{path}: row {number}: expected {len(heading.names)} cells, got {len(cells)}")
            name = channel_by_tag.get(cells[tag].strip())
            if name is None:
                other_tags.add(cells[tag].strip())
                continue
            try:
                time = read(cells[time_column]) if clock.stamps else number_in(cells[time_column], heading.delimiter)
                flag = None if quality is None else cells[quality]
                reading = apply_rule(cells[value], flag, rules[name], heading.delimiter)
            except ValueError as error:
                raise ValueError(f"{path}: row {number} ({cells[tag].strip()}): {error}") from None
            rows[name].append((number, time, reading))
    return clock, [_tagged(path, name, sources[name], rows[name], other_tags) for name in names], read


def _tagged(
    path: Path, name: str, source: ChannelSource, rows: Sequence[tuple[int, float, float]], other_tags: set[str]
) -> Tagged:
    tag = source.column or name
    if not rows:
        known = ", ".join(sorted(other_tags)[:12]) or "none"
        raise ValueError(
            f"{path}: expected rows of the tag {tag} for {name}, got {known}{nearest(tag, sorted(other_tags))}; "
            f"name it under columns: {{{name}: {{column: ..., unit: ...}}}}"
        )
    if source.unit is None:
        raise ValueError(
            f"{path}: {name}: expected the unit of {tag}, got none; give it under columns: {{{name}: {{unit: ...}}}}"
        )
    try:
        si_unit = si_unit_of(source.unit)
    except ValueError as error:
        raise ValueError(f"{path}: {name}: {error}") from None
    bound = Bound(name, tag, 0, unit_factor(source.unit, si_unit), si_unit, unit=source.unit)
    numbers, times, values = map(np.array, zip(*rows, strict=True))
    return bound, numbers, times, values
