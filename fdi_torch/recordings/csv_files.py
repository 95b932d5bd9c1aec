"""Recordings from CSV files (plain or .gz), and from other tables in the same way, read in blocks of lines.

A header of the form name_unit (`t_s`, `Q1_cm3_s`, `h1_cm`) or name [unit] is complete; other headers are mapped by
`ChannelSource`. Empty and non-finite cells are allowed in channels (a missing reading, an unknown command) but not in
time. A time without unit consists of time stamps; the first time stamp, or first number of seconds since 1970, is t =
0.
"""

from __future__ import annotations

import gzip
import hashlib
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from fdi_torch.recording import Hold, Recording
from fdi_torch.recordings.csv_binding import Bound, bind, bind_table, unit_notes
from fdi_torch.recordings.csv_cells import Columns, parse_carefully, parse_fast
from fdi_torch.recordings.csv_tags import read_tags
from fdi_torch.recordings.csv_text import heading_of, names_in, open_csv
from fdi_torch.recordings.sheets import Sheet, in_order, informative_rows, merge_sheets, without_missing_rows
from fdi_torch.recordings.source import ChannelSource, ClockSource, FileSource, clock_in, file_sha256
from fdi_torch.recordings.time_stamps import StampReader, from_zone, offset_of_zone, seconds_of
from fdi_torch.units import spelled

LINES_PER_BLOCK = 1 << 16
ROWS_OF_CLOCK = 1000
"""Rows in which a clock is looked for, where none is named."""
SINCE_1970 = 1e8  # s; larger times are taken to be seconds since 1970


@dataclass(frozen=True)
class Read:
    """The requested channels of one file: sheets, SI units, units in the file, constants, and notes on corrections."""

    sheets: Sequence[Sheet]
    units: Mapping[str, str]
    written: Mapping[str, str]
    constants: Mapping[str, float]
    stamps: bool
    zone: float
    notes: Sequence[str]


def read_csv(
    path: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    mapping: Mapping[str, ChannelSource] | None = None,
    hold: Hold = "zero_order",
) -> Recording:
    """The named channels of a CSV file as a recording in SI. In `mapping`, time has the name `t`.

    Raises ValueError, naming file, row and column, for a missing column (with the nearest header), a cell that is not a
    number, time that does not increase, and a file without rows.
    """
    return read_csv_files([FileSource(path, mapping or {})], inputs, outputs, hold)


def read_csv_files(
    files: Sequence[FileSource], inputs: Sequence[str], outputs: Sequence[str], hold: Hold = "zero_order"
) -> Recording:
    """The named channels of several files on the union of their times.

    A channel is taken from the first file whose `columns` name it, or else from the first with it in its header.
    """
    names_by_file = _assign_to_files(files, (*inputs, *outputs))
    parts = [_read(file, names) for file, names in zip(files, names_by_file, strict=True) if names]
    sources = {
        name: f.columns[name]
        for f, names in zip(files, names_by_file, strict=True)
        for name in names
        if name in f.columns
    }
    hold_times = {name: sources[name].held if name in sources else 0.0 for name in inputs}
    merged = merge_sheets([sheet for p in parts for sheet in p.sheets], hold_times, hold)
    constants = {name: value for p in parts for name, value in p.constants.items()}
    units = {name: unit for p in parts for name, unit in p.units.items()}
    commands, readings = (_columns(merged, names, constants) for names in (inputs, outputs))
    rows = informative_rows(commands, readings, hold) if sum(len(p.sheets) for p in parts) > 1 else slice(None)
    seconds = merged.seconds[rows]
    since_1970 = any(p.stamps for p in parts) or float(seconds[0]) > SINCE_1970
    return Recording(
        time=torch.from_numpy(np.round(seconds - seconds[0], 6) if since_1970 else seconds),
        inputs=torch.from_numpy(without_missing_rows(seconds, commands[rows], list(hold_times.values()))),
        outputs=torch.from_numpy(readings[rows]),
        input_names=tuple(inputs),
        output_names=tuple(outputs),
        input_units=tuple(units[name] for name in inputs),
        output_units=tuple(units[name] for name in outputs),
        hold=hold,
        source=str(files[0].path),
        sha256=_sha256([file.path for file in files]),
        began=float(seconds[0]) if since_1970 else None,
        zone=next((p.zone for p in parts if p.stamps), 0.0),
        notes=tuple(note for p in parts for note in p.notes),
        written={name: unit for p in parts for name, unit in p.written.items()},
    )


def _assign_to_files(files: Sequence[FileSource], names: Sequence[str]) -> list[list[str]]:
    """The channels to read from each file. One that no file has is left to the first, whose reader reports it."""
    names_by_file: list[list[str]] = [[] for _ in files]
    headers = [names_in(read_header(file.path, file.header, file.sheet)) if len(files) > 1 else set() for file in files]
    for name in names:
        mapped = [k for k, file in enumerate(files) if name in file.columns]
        present = [k for k, header in enumerate(headers) if name in header]
        names_by_file[(mapped or present or [0])[0]].append(name)
    return names_by_file


Rows = tuple[str, np.ndarray, np.ndarray, Sequence[Bound], np.ndarray]
"""Rows of channels with common times: their tag for messages, row numbers, cells of the clock, channels, and values."""


def _read(file: FileSource, names: Sequence[str]) -> Read:
    """The channels of a file, in order of time: in one sheet, or in one for each tag."""
    path, source = file.path, clock_in(file.columns)
    clock, bounds, parts, notes, stamps = _tagged_rows(file, names) if file.tags else _table_rows(file, names)
    sheets = []
    for tag, numbers, cells, channels, values in parts:
        place, of = f"{path}: row {{}}{tag}, column {clock.header}", tag[2:-1]
        times = _clock(cells, clock, source, place, numbers)
        hint = _summer_time_hint(clock, source)
        seconds, ordered, changes = in_order(times, values, source.sort, place, numbers, hint)
        sheets.append(Sheet(f"{path}{tag}", seconds, tuple(b.name for b in channels), ordered))
        notes += [f"{of}: {note}" if of else note for note in changes]
    first = float(sheets[0].seconds[0]) if sheets else 0.0
    return Read(
        sheets,
        {b.name: b.si_unit for b in bounds},
        {b.name: spelled(b.unit) for b in (clock, *bounds) if b.unit},
        {b.name: b.constant for b in bounds if b.position is None},
        clock.stamps,
        offset_of_zone(first, source.zone) if sheets and source.zone else stamps.offset,
        [f"{path.name}: {note}" for note in notes],
    )


def _table_rows(
    file: FileSource, names: Sequence[str]
) -> tuple[Bound, list[Bound], list[Rows], list[str], StampReader]:
    """The clock, all channels, their rows, notes, and the reader of time stamps of a file with a row per instant."""
    path = file.path
    with open_csv(path, file.sheet) as handle:
        heading, lines = heading_of(path, handle, file.header)
        clock, bounds, columns = bind_table(path, heading, names, file.columns)
        table, notes = _read_table(lines, columns)
    numbers = np.arange(len(table))
    cells = numbers if clock.position is None else table[:, 0]
    in_file = [b for b in bounds if b.position is not None]
    rows = ("", numbers + heading.lines + 1, cells, in_file, channels_in_si(table, columns, in_file))
    return clock, bounds, [rows], [*unit_notes(bounds), *notes], columns.read_stamp


def _tagged_rows(
    file: FileSource, names: Sequence[str]
) -> tuple[Bound, list[Bound], list[Rows], list[str], StampReader]:
    """As `_table_rows`, of a file with a row per value."""
    constant = [name for name in names if (source := file.columns.get(name)) and source.constant is not None]
    clock, tagged, stamps = read_tags(file, [name for name in names if name not in constant])
    rows: list[Rows] = [
        (f" ({bound.header})", numbers, times, [bound], (values * np.float64(bound.factor))[:, None])
        for bound, numbers, times, values in tagged
    ]
    bounds = [bound for bound, *_ in tagged] + [bind(file.path, (), name, file.columns[name]) for name in constant]
    return clock, bounds, rows, [], stamps


def _columns(whole: Sheet, names: Sequence[str], constants: Mapping[str, float]) -> np.ndarray:
    """The named channels (T, C)."""
    table = np.empty((len(whole.seconds), len(names)))
    for k, name in enumerate(names):
        table[:, k] = constants[name] if name in constants else whole.values[:, whole.names.index(name)]
    return table


def _summer_time_hint(clock: Bound, clock_source: ClockSource) -> str:
    """Hint for a clock that is set back at the end of summer time; empty if a time zone is given."""
    hint = "where summer time ends, say in which zone this is: columns: {t: {zone: Europe/Berlin}}"
    return hint if clock.stamps and not clock_source.zone else ""


def _sha256(paths: Sequence[Path]) -> str:
    """The file's hash, or the hash of several files' hashes."""
    each = [file_sha256(path) for path in paths]
    return each[0] if len(each) == 1 else hashlib.sha256("".join(each).encode()).hexdigest()


def read_header(path: Path, header: bool = True, sheet: str | None = None) -> tuple[str, ...]:
    """The column names of a table, laid out as described in `FileSource`."""
    with open_csv(path, sheet) as handle:
        return heading_of(path, handle, header)[0].names


def first_row(path: Path) -> list[str]:
    """The cells of the first row of a table without a header."""
    with open_csv(path, None) as handle:
        heading, lines = heading_of(path, handle, header=False)
        return next(lines, "").strip().split(heading.delimiter)


def clock_of(path: Path) -> tuple[int, bool] | None:
    """The number of the first column that increases as a clock does in a table without a header, from 1, and whether it
    has time stamps; None if there is none. A clock never goes back, and stands still in less than half of the rows.
    """
    with open_csv(path, None) as handle:
        heading, lines = heading_of(path, handle, header=False)
        rows = [line.strip().split(heading.delimiter) for line in islice(lines, ROWS_OF_CLOCK)]
    for k in range(len(rows[0]) if rows else 0):
        cells = [row[k] for row in rows if k < len(row)]
        for read, stamps in ((_number, False), (seconds_of, True)):
            try:
                steps = np.diff([read(cell) for cell in cells])
            except ValueError:
                continue
            if (steps >= 0.0).all() and (steps > 0.0).sum() > 0.5 * len(steps):
                return k + 1, stamps
    return None


def _number(cell: str) -> float:
    return float(cell.strip().strip('"').replace(",", "."))


def _read_table(lines: Iterator[str], columns: Columns) -> tuple[np.ndarray, list[str]]:
    """The columns (rows, columns) float64, non-finite where there is no number, and notes on omitted lines."""
    blocks, above, notes = [], columns.heading.lines, []
    for block in _blocks(columns.path, lines):
        if cut := cut_off(block[-1], columns):
            block = block[:-1]
            notes.append(f"the last line is cut off and left out: '{cut}'")
        try:
            blocks.append(parse_fast(block, columns))
        except ValueError:
            blocks.append(parse_carefully(block, columns, above))
        above += len(block)
    table = np.concatenate(blocks) if blocks else np.empty((0, len(columns.positions)))
    if len(table) < 2:
        raise ValueError(f"{columns.path}: expected at least two rows of numbers, got {len(table)}")
    return table, notes


def cut_off(line: str, columns: Columns) -> str:
    """The text of a last line that was not completely written; empty if it is complete."""
    whole = line.endswith(("\n", "\r")) or line.count(columns.heading.delimiter) >= len(columns.heading.names) - 1
    return "" if whole else line[:60]


def _blocks(path: Path, lines: Iterable[str]) -> Iterator[list[str]]:
    try:
        while block := list(islice(lines, LINES_PER_BLOCK)):
            yield block
    except (UnicodeDecodeError, EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path}: expected a whole CSV file, got one that is cut off or damaged: {error}") from None


def _clock(cells: np.ndarray, clock: Bound, source: ClockSource, place: str, rows: np.ndarray) -> np.ndarray:
    """Time of each row (R,), s, since 1970 for time stamps. place: format of a row in messages; rows: their numbers."""
    seconds = cells * clock.factor
    if not np.isfinite(seconds).all():
        number = rows[np.flatnonzero(~np.isfinite(seconds))[0]]
        raise ValueError(f"{place.format(number)}: expected a time in every row, got none")
    if source.zone:
        seconds = from_zone(seconds, source.zone)
    return seconds + source.shift if source.shift else seconds


def from_first(seconds: np.ndarray, first: float, clock: Bound) -> np.ndarray:
    """Time since the first sample, s, for time stamps and for seconds since 1970; other times unchanged."""
    return np.round(seconds - first, 6) if clock.stamps or first > SINCE_1970 else seconds


def channels_in_si(table: np.ndarray, columns: Columns, bounds: Sequence[Bound]) -> np.ndarray:
    """The bound channels in SI as (rows, channels)."""
    channels = np.empty((len(table), len(bounds)))
    for i, bound in enumerate(bounds):
        channels[:, i] = _numbers(table, columns, bound)
        for further in bound.plus:
            channels[:, i] += _numbers(table, columns, further)
    return channels


def _numbers(table: np.ndarray, columns: Columns, bound: Bound) -> np.ndarray:
    source = bound.constant if bound.position is None else table[:, columns.positions.index(bound.position)]
    return np.asarray(source * np.float64(bound.factor))
