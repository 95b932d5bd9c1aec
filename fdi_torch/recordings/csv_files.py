"""Recordings from CSV files (plain or .gz), read in blocks of lines: a long file costs its numbers and little more.

A header of the form name_unit (`t_s`, `Q1_cm3_s`, `h1_cm`) or name [unit] tells all; other headers are mapped by
`ChannelSource`. Empty and non-finite cells are allowed in channels (a missing reading, an unknown command), never in
time. Where time has no unit it is ISO time stamps; of these, and of seconds since 1970, the first is t = 0.
"""

from __future__ import annotations

import difflib
import gzip
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from fdi_torch.parameters import header_unit, si_unit_of, unit_factor
from fdi_torch.recording import Hold, Recording
from fdi_torch.recordings.csv_cells import Columns, parse_carefully, parse_fast
from fdi_torch.recordings.csv_text import Heading, heading_of, open_csv
from fdi_torch.recordings.source import ChannelSource, file_sha256

LINES_PER_BLOCK = 1 << 16
SINCE_1970 = 1e8  # s; later than that is no rig's own clock
TIME_NAMES = ("t", "time", "timestamp", "datetime", "date time", "date_time", "date/time")


@dataclass(frozen=True)
class Bound:
    """A channel tied to the file: position of its column (or a constant), factor into SI, SI unit.

    stamps: its cells are time stamps.
    """

    name: str
    header: str
    position: int | None
    factor: float
    si_unit: str
    constant: float = float("nan")
    stamps: bool = False


def read_csv(
    path: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    mapping: Mapping[str, ChannelSource] | None = None,
    hold: Hold = "zero_order",
) -> Recording:
    """The named channels of a CSV file as a recording in SI. In `mapping`, time goes by the name `t`.

    Raises ValueError, naming file, row and column, for a missing column (with the nearest one there is), a cell that
    is no number, time that does not increase, and a file without rows.
    """
    mapping = mapping or {}
    with open_csv(path) as handle:
        heading, lines = heading_of(path, handle)
        clock = bind_clock(path, heading.names, mapping.get("t"))
        bound_inputs = [bind(path, heading.names, name, mapping.get(name)) for name in inputs]
        bound_outputs = [bind(path, heading.names, name, mapping.get(name)) for name in outputs]
        columns = columns_of(path, heading, [clock, *bound_inputs, *bound_outputs])
        table = _read_table(lines, columns)
    return Recording(
        time=torch.from_numpy(_clock(table[:, 0], clock, columns)),
        inputs=torch.from_numpy(channels_in_si(table, columns, bound_inputs)),
        outputs=torch.from_numpy(channels_in_si(table, columns, bound_outputs)),
        input_names=tuple(inputs),
        output_names=tuple(outputs),
        input_units=tuple(b.si_unit for b in bound_inputs),
        output_units=tuple(b.si_unit for b in bound_outputs),
        hold=hold,
        source=str(path),
        sha256=file_sha256(path),
    )


def read_header(path: Path) -> tuple[str, ...]:
    """The column names of a CSV file."""
    with open_csv(path) as handle:
        return heading_of(path, handle)[0].names


def bind_clock(path: Path, header: Sequence[str], source: ChannelSource | None) -> Bound:
    """The column of time: the one mapped, or t_UNIT or time_UNIT, or one of `TIME_NAMES` that holds time stamps."""
    if source is None:
        split = {h: header_unit(h) for h in header}
        timed = [h for h, found in split.items() if found and found[0].lower() in ("t", "time")]
        stamped = [h for h in header if h.lower() in TIME_NAMES]
        source = ChannelSource((timed or stamped or ["t"])[0])
    column = _find_column(path, header, "t", source.column)
    if source.unit is None and header_unit(column) is None:
        return Bound("t", column, header.index(column), 1.0, "s", stamps=True)
    return bind(path, header, "t", source, "s")


def bind(path: Path, header: Sequence[str], name: str, source: ChannelSource | None, want: str | None = None) -> Bound:
    source = source or ChannelSource()
    if source.constant is not None:
        unit = source.unit or "1"
        return Bound(name, name, None, 1.0, unit, source.constant)
    column = _find_column(path, header, name, source.column)
    unit = source.unit or _unit_in(path, column, name)
    try:
        si_unit = want or si_unit_of(unit)
        factor = unit_factor(unit, si_unit)
    except ValueError as error:
        raise ValueError(f"{path}: column {column}: {error}") from error
    return Bound(name, column, header.index(column), factor, si_unit)


def _find_column(path: Path, header: Sequence[str], name: str, column: str | None) -> str:
    """The column mapped to a channel: by its whole header, or by the name in a header of the form name_unit."""
    wanted = column or name
    splits = [(h, header_unit(h)) for h in header]
    meant = [h for h in header if h == wanted] or [h for h, split in splits if split and split[0] == wanted]
    if len(meant) > 1:
        fix = f"map one under columns: {{{name}: {{column: {meant[0]}}}}}" if meant[0] != meant[1] else "rename one"
        raise ValueError(f"{path}: expected one column for {name}, got {' and '.join(meant)}; {fix}")
    if meant:
        return meant[0]
    names = {split[0]: h for h, split in splits if split}
    near = difflib.get_close_matches(wanted, [*header, *names], n=1, cutoff=0.5)
    near = [h for h in header if h.lower().startswith(wanted.lower())] or near if len(wanted) > 1 else near
    hint = f"; the nearest is {names.get(near[0], near[0])}" if near else ""
    raise ValueError(
        f"{path}: expected a column for {name} ('{wanted}' or '{wanted}_UNIT'), got {', '.join(header)}{hint}; "
        f"map it under columns: {{{name}: {{column: ..., unit: ...}}}}"
    )


def _unit_in(path: Path, column: str, name: str) -> str:
    split = header_unit(column)
    if split is None:
        raise ValueError(
            f"{path}: column {column}: expected a header of the form name_unit such as h1_cm, got no unit in it; "
            f"give the unit under columns: {{{name}: {{column: {column}, unit: ...}}}}"
        )
    return split[1]


def columns_of(path: Path, heading: Heading, bounds: Sequence[Bound]) -> Columns:
    """The columns of the file that are read, each once, in the order of their first use: time comes first."""
    positions = list(dict.fromkeys(b.position for b in bounds if b.position is not None))
    return Columns(path, heading, positions, next((b.position for b in bounds if b.stamps), None))


def _read_table(lines: Iterator[str], columns: Columns) -> np.ndarray:
    """The wanted columns as (rows, columns) float64; missing cells are NaN."""
    blocks, above = [], columns.heading.lines
    for block in _blocks(columns.path, lines):
        try:
            blocks.append(parse_fast(block, columns))
        except ValueError:
            blocks.append(parse_carefully(block, columns, above))
        above += len(block)
    table = np.concatenate(blocks) if blocks else np.empty((0, len(columns.positions)))
    if len(table) < 2:
        raise ValueError(f"{columns.path}: expected at least two rows of numbers, got {len(table)}")
    return table


def _blocks(path: Path, lines: Iterable[str]) -> Iterator[list[str]]:
    try:
        while block := list(islice(lines, LINES_PER_BLOCK)):
            yield block
    except (UnicodeDecodeError, EOFError, gzip.BadGzipFile) as error:
        raise ValueError(f"{path}: expected a whole CSV file, got one that is cut off or damaged: {error}") from error


def _clock(seconds: np.ndarray, clock: Bound, columns: Columns) -> np.ndarray:
    place, first = f"{columns.path}: row {{}}, column {clock.header}", columns.heading.lines + 1
    seconds = from_first(seconds * clock.factor, seconds[0] * clock.factor, clock)
    if not np.isfinite(seconds).all():
        row = first + int(np.flatnonzero(~np.isfinite(seconds))[0])
        raise ValueError(f"{place.format(row)}: expected a time in every row, got none")
    back = np.flatnonzero(np.diff(seconds) <= 0)
    if len(back):
        before, after = seconds[back[0]], seconds[back[0] + 1]
        rows = "one such row" if len(back) == 1 else f"{len(back)} such rows"
        summer = "; where summer time ends, give each stamp its offset (+01:00)" if clock.stamps else ""
        raise ValueError(
            f"{place.format(first + 1 + int(back[0]))}: expected time that increases, got "
            f"{after:g} s after {before:g} s ({rows}); sort the rows or drop the repeated ones{summer}"
        )
    return seconds


def from_first(seconds: np.ndarray, first: float, clock: Bound) -> np.ndarray:
    """Time stamps, and numbers so large that they count from 1970, as seconds since the first; others as they are."""
    return np.round(seconds - first, 6) if clock.stamps or first > SINCE_1970 else seconds


def channels_in_si(table: np.ndarray, columns: Columns, bounds: Sequence[Bound]) -> np.ndarray:
    """The bound channels in SI as (rows, channels); what is not finite becomes NaN."""
    channels = np.empty((len(table), len(bounds)))
    for i, bound in enumerate(bounds):
        source = bound.constant if bound.position is None else table[:, columns.positions.index(bound.position)]
        channels[:, i] = source * np.float64(bound.factor)
    channels[~np.isfinite(channels)] = np.nan
    return channels


def write_csv(recording: Recording, path: Path) -> Path:
    """The recording as CSV whose headers need no mapping: t_s, Q1_cm3_s, h1_cm ... Masked readings are left empty."""
    units = [_FILE_UNITS.get(unit, unit) for unit in (*recording.input_units, *recording.output_units)]
    names = (*recording.input_names, *recording.output_names)
    si_units = (*recording.input_units, *recording.output_units)
    factors = [unit_factor(si, unit) for si, unit in zip(si_units, units, strict=True)]
    readings = torch.where(recording.mask, recording.outputs, torch.nan)
    table = torch.cat([recording.inputs, readings], dim=1).numpy() * np.asarray(factors)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as handle:
        handle.write(",".join(["t_s", *(f"{n}_{u}" for n, u in zip(names, units, strict=True))]) + "\n")
        for t, row in zip(recording.time.tolist(), table, strict=True):
            cells = ("" if np.isnan(value) else f"{value:.12g}" for value in row.tolist())
            handle.write(f"{t:.12g}," + ",".join(cells) + "\n")
    return path


_FILE_UNITS = {"m": "cm", "m^3/s": "cm3_s", "Pa": "mbar", "A": "mA", "1/s": "Hz", "1": "pct"}
