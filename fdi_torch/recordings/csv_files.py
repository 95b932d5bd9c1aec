"""Recordings from CSV files (plain or .gz), and from other tables as if they were, read in blocks of lines: a long file
costs its numbers and little more.

A header of the form name_unit (`t_s`, `Q1_cm3_s`, `h1_cm`) or name [unit] tells all; other headers are mapped by
`ChannelSource`. Empty and non-finite cells are allowed in channels (a missing reading, an unknown command), never in
time. Where time has no unit it is time stamps; of these, and of seconds since 1970, the first is t = 0.
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

from fdi_torch.disk import replacing
from fdi_torch.parameters import header_unit, unit_factor
from fdi_torch.recording import Hold, Recording
from fdi_torch.recordings.csv_binding import Bound, bind, bind_clock, columns_of
from fdi_torch.recordings.csv_cells import Columns, parse_carefully, parse_fast
from fdi_torch.recordings.csv_tags import read_tags
from fdi_torch.recordings.csv_text import heading_of, open_csv
from fdi_torch.recordings.sheets import Sheet, in_order, telling_rows, woven
from fdi_torch.recordings.source import ChannelSource, ClockSource, FileSource, file_sha256
from fdi_torch.recordings.stamps import from_zone

LINES_PER_BLOCK = 1 << 16
SINCE_1970 = 1e8  # s; later than that is no rig's own clock


@dataclass(frozen=True)
class Read:
    """What one file has of the channels asked of it: sheets, SI units, constants, and sentences on what was done."""

    sheets: Sequence[Sheet]
    units: Mapping[str, str]
    constants: Mapping[str, float]
    stamps: bool
    notes: Sequence[str]


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
    return read_csv_files([FileSource(path, mapping or {})], inputs, outputs, hold)


def read_csv_files(
    files: Sequence[FileSource], inputs: Sequence[str], outputs: Sequence[str], hold: Hold = "zero_order"
) -> Recording:
    """The same from several files, on the union of their times: a channel is taken from the first file whose `columns`
    name it, or else that has it in its header.
    """
    shares = _shared_out(files, (*inputs, *outputs))
    parts = [_read(file, names) for file, names in zip(files, shares, strict=True) if names]
    sources = {n: f.columns[n] for f, names in zip(files, shares, strict=True) for n in names if n in f.columns}
    stands = {name: sources[name].held if name in sources else 0.0 for name in inputs}
    whole = woven([sheet for part in parts for sheet in part.sheets], stands, hold)
    constants = {name: value for part in parts for name, value in part.constants.items()}
    units = {name: unit for part in parts for name, unit in part.units.items()}
    commands, readings = (_columns(whole, names, constants) for names in (inputs, outputs))
    rows = telling_rows(commands, readings, hold) if sum(len(part.sheets) for part in parts) > 1 else slice(None)
    seconds = whole.seconds[rows]
    since_1970 = any(part.stamps for part in parts) or float(seconds[0]) > SINCE_1970
    return Recording(
        time=torch.from_numpy(np.round(seconds - seconds[0], 6) if since_1970 else seconds),
        inputs=torch.from_numpy(commands[rows]),
        outputs=torch.from_numpy(readings[rows]),
        input_names=tuple(inputs),
        output_names=tuple(outputs),
        input_units=tuple(units[name] for name in inputs),
        output_units=tuple(units[name] for name in outputs),
        hold=hold,
        source=str(files[0].path),
        sha256=_sha256([file.path for file in files]),
        began=float(seconds[0]) if since_1970 else None,
        notes=tuple(note for part in parts for note in part.notes),
    )


def _shared_out(files: Sequence[FileSource], names: Sequence[str]) -> list[list[str]]:
    """Which channels are taken from which file; what none has, from the first, which says so."""
    shares: list[list[str]] = [[] for _ in files]
    headers = [
        _named_in(read_header(file.path, file.header, file.sheet)) if len(files) > 1 else set() for file in files
    ]
    for name in names:
        said = [k for k, file in enumerate(files) if name in file.columns]
        there = [k for k, header in enumerate(headers) if name in header]
        shares[(said or there or [0])[0]].append(name)
    return shares


def _named_in(header: Sequence[str]) -> set[str]:
    return {*header, *(split[0] for column in header if (split := header_unit(column)))}


def _read(file: FileSource, names: Sequence[str]) -> Read:
    return _read_tagged(file, names) if file.tags else _read_rows(file, names)


def _read_rows(file: FileSource, names: Sequence[str]) -> Read:
    """A file with a row an instant: one sheet."""
    path, given = file.path, file.columns.get("t")
    with open_csv(path, file.sheet) as handle:
        heading, lines = heading_of(path, handle, file.header)
        clock = bind_clock(path, heading.names, given)
        bounds = [bind(path, heading.names, name, file.columns.get(name)) for name in names]
        sparse = any(file.columns[name].held > 0.0 for name in names if name in file.columns)
        columns = columns_of(path, heading, [clock, *bounds], given, sparse)
        table, notes = _read_table(lines, columns)
    place, first = f"{path}: row {{}}, column {clock.header}", heading.lines + 1
    seconds = _clock(table[:, 0], clock, given, place, first)
    there = [b for b in bounds if b.position is not None]
    values = channels_in_si(table, columns, there)
    order = in_order(seconds, values, _sorted(given), place, first, _summer(clock, given))
    sheet = Sheet(str(path), order.seconds, tuple(b.name for b in there), order.values)
    return Read([sheet], *_kinds(bounds), clock.stamps, [f"{path.name}: {n}" for n in (*notes, *order.told)])


def _read_tagged(file: FileSource, names: Sequence[str]) -> Read:
    """A file with a row a value: a sheet a channel."""
    path, given = file.path, file.columns.get("t")
    constant = [name for name in names if (source := file.columns.get(name)) and source.constant is not None]
    clock, found = read_tags(file, [name for name in names if name not in constant])
    sheets, notes = [], []
    for bound, rows, stamps, numbers in found:
        place = f"{path}: row {{}} ({bound.header}), column {clock.header}"
        seconds = _clock(stamps, clock, given, place, 0, rows)
        values = (numbers * np.float64(bound.factor))[:, None]
        order = in_order(seconds, values, _sorted(given), place, 0, _summer(clock, given), rows)
        sheets.append(Sheet(f"{path} ({bound.header})", order.seconds, (bound.name,), order.values))
        notes += [f"{path.name}: {bound.header}: {note}" for note in order.told]
    bounds = [bound for bound, *_ in found] + [bind(path, (), name, file.columns[name]) for name in constant]
    return Read(sheets, *_kinds(bounds), clock.stamps, notes)


def _kinds(bounds: Sequence[Bound]) -> tuple[dict[str, str], dict[str, float]]:
    """SI units of the channels, and the values of those that are constant."""
    return {b.name: b.si_unit for b in bounds}, {b.name: b.constant for b in bounds if b.position is None}


def _columns(whole: Sheet, names: Sequence[str], constants: Mapping[str, float]) -> np.ndarray:
    """The named channels (T, C)."""
    table = np.empty((len(whole.seconds), len(names)))
    for k, name in enumerate(names):
        table[:, k] = constants[name] if name in constants else whole.values[:, whole.names.index(name)]
    return table


def _sorted(clock: ChannelSource | None) -> bool:
    return isinstance(clock, ClockSource) and clock.sort


def _summer(clock: Bound, given: ChannelSource | None) -> str:
    zoned = isinstance(given, ClockSource) and given.zone
    told = "where summer time ends, say in which zone this is: columns: {t: {zone: Europe/Berlin}}"
    return told if clock.stamps and not zoned else ""


def _sha256(paths: Sequence[Path]) -> str:
    """Of the file, or of several files' one after the other."""
    each = [file_sha256(path) for path in paths]
    return each[0] if len(each) == 1 else hashlib.sha256("".join(each).encode()).hexdigest()


def read_header(path: Path, header: bool = True, sheet: str | None = None) -> tuple[str, ...]:
    """The column names of a table, as `FileSource` says how it is laid out."""
    with open_csv(path, sheet) as handle:
        return heading_of(path, handle, header)[0].names


def _read_table(lines: Iterator[str], columns: Columns) -> tuple[np.ndarray, list[str]]:
    """The wanted columns as (rows, columns) float64, cells without a number not finite; and what was left out."""
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
    """What there is of a last line that a program had not yet written to its end; nothing where it is whole."""
    whole = line.endswith(("\n", "\r")) or line.count(columns.heading.delimiter) >= len(columns.heading.names) - 1
    return "" if whole else line[:60]


def _blocks(path: Path, lines: Iterable[str]) -> Iterator[list[str]]:
    try:
        while block := list(islice(lines, LINES_PER_BLOCK)):
            yield block
    except (UnicodeDecodeError, EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path}: expected a whole CSV file, got one that is cut off or damaged: {error}") from error


def _clock(
    cells: np.ndarray, clock: Bound, given: ChannelSource | None, place: str, first: int, rows: np.ndarray | None = None
) -> np.ndarray:
    """Seconds (R,), since 1970 for time stamps. place: of a row, whose number is counted
    from `first`, or stands in `rows`.
    """
    seconds = cells * clock.factor
    if not np.isfinite(seconds).all():
        row = int(np.flatnonzero(~np.isfinite(seconds))[0])
        number = first + row if rows is None else int(rows[row])
        raise ValueError(f"{place.format(number)}: expected a time in every row, got none")
    if not isinstance(given, ClockSource):
        given = ClockSource()
    if given.zone:
        seconds = from_zone(seconds, given.zone)
    return seconds + given.shift if given.shift else seconds


def from_first(seconds: np.ndarray, first: float, clock: Bound) -> np.ndarray:
    """Time stamps, and numbers so large that they count from 1970, as seconds since the first; others as they are."""
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


def write_csv(recording: Recording, path: Path) -> Path:
    """The recording as CSV whose headers need no mapping: t_s, Q1_cm3_s, h1_cm ... Masked readings are left empty."""
    units = [_FILE_UNITS.get(unit, unit) for unit in (*recording.input_units, *recording.output_units)]
    si_units = (*recording.input_units, *recording.output_units)
    factors = [unit_factor(si, unit) for si, unit in zip(si_units, units, strict=True)]
    readings = torch.where(recording.mask, recording.outputs, torch.nan)
    table = torch.cat([recording.inputs, readings], dim=1).numpy() * np.asarray(factors)
    with replacing(path) as new, new.open("w", encoding="utf-8", newline="") as handle:
        inputs = dict(zip(recording.input_names, recording.input_units, strict=True))
        handle.write(header_of(inputs, dict(zip(recording.output_names, recording.output_units, strict=True))) + "\n")
        for t, row in zip(recording.time.tolist(), table, strict=True):
            cells = ("" if np.isnan(value) else f"{value:.12g}" for value in row.tolist())
            handle.write(f"{t:.12g}," + ",".join(cells) + "\n")
    return path


def header_of(inputs: Mapping[str, str], outputs: Mapping[str, str]) -> str:
    """A header that needs no mapping, from channels' names and SI units: t_s,Q1_cm3_s,h1_cm."""
    named = (*inputs.items(), *outputs.items())
    return ",".join(["t_s", *(f"{name}_{_FILE_UNITS.get(unit, unit)}" for name, unit in named)])


_FILE_UNITS = {"m": "cm", "m^3/s": "cm3_s", "Pa": "mbar", "A": "mA", "1/s": "Hz", "1": "pct"}
