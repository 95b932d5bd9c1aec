"""Recordings from CSV files (plain or .gz), read in blocks of lines: a long file costs its numbers and little more.

A header of the form name_unit (`t_s`, `Q1_cm3_s`, `h1_cm`) tells all; other headers are mapped by `ChannelSource`.
Empty and non-finite cells are allowed in channels (a missing reading, an unknown command), never in time.
"""

from __future__ import annotations

import csv
import difflib
import gzip
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np
import torch

from fdi_torch.parameters import header_unit, si_unit_of, unit_factor
from fdi_torch.recording import Hold, Recording
from fdi_torch.recordings.source import ChannelSource, file_sha256

LINES_PER_BLOCK = 1 << 16
MISSING_WORDS = frozenset({"", "nan", "na", "n/a", "null", "none", "-"})


@dataclass(frozen=True)
class Bound:
    """A channel tied to the file: position of its column (or a constant), factor into SI, SI unit."""

    name: str
    header: str
    position: int | None
    factor: float
    si_unit: str
    constant: float = float("nan")


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
        header, delimiter, line = header_of(path, handle)
        clock = bind(path, header, "t", mapping.get("t") or time_source(header), "s")
        bound_inputs = [bind(path, header, name, mapping.get(name)) for name in inputs]
        bound_outputs = [bind(path, header, name, mapping.get(name)) for name in outputs]
        positions = positions_of([clock, *bound_inputs, *bound_outputs])
        table = _read_table(path, handle, header, delimiter, line, positions)
    seconds = _clock(path, table[:, 0], clock, line)
    return Recording(
        time=torch.from_numpy(seconds),
        inputs=torch.from_numpy(channels_in_si(table, positions, bound_inputs)),
        outputs=torch.from_numpy(channels_in_si(table, positions, bound_outputs)),
        input_names=tuple(inputs),
        output_names=tuple(outputs),
        input_units=tuple(b.si_unit for b in bound_inputs),
        output_units=tuple(b.si_unit for b in bound_outputs),
        hold=hold,
        source=str(path),
        sha256=file_sha256(path),
    )


def read_header(path: Path) -> list[str]:
    """The column names of a CSV file."""
    with open_csv(path) as handle:
        return header_of(path, handle)[0]


def open_csv(path: Path) -> TextIO:
    if not path.is_file():
        raise ValueError(f"{path}: expected a CSV file, got none there; check the path")
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8-sig", newline="")
    return path.open(encoding="utf-8-sig", newline="")


def header_of(path: Path, handle: TextIO) -> tuple[list[str], str, int]:
    """Column names, delimiter, and the number of the header's line. Lines starting with # may stand above it."""
    try:
        for line_number, line in enumerate(handle, start=1):
            if line.strip() and not line.startswith("#"):
                delimiter = max(",;\t", key=line.count)
                return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))], delimiter, line_number
    except (UnicodeDecodeError, gzip.BadGzipFile) as error:
        raise ValueError(f"{path}: expected a CSV file (UTF-8, plain or .gz), got something else: {error}") from error
    raise ValueError(f"{path}: expected a header line such as t_s,Q1_cm3_s,h1_cm, got an empty file")


def time_source(header: Sequence[str]) -> ChannelSource:
    """The column of time where the mapping names none: t_UNIT or time_UNIT."""
    for column in header:
        split = header_unit(column)
        if split and split[0].lower() in ("t", "time"):
            return ChannelSource(column)
    return ChannelSource()


def bind(path: Path, header: Sequence[str], name: str, source: ChannelSource | None, want: str | None = None) -> Bound:
    source = source or ChannelSource()
    if source.constant is not None:
        unit = source.unit or "1"
        return Bound(name, name, None, 1.0, unit, source.constant)
    column = _find_column(path, header, name, source.column)
    unit = source.unit or _unit_in(path, column)
    try:
        si_unit = want or si_unit_of(unit)
        factor = unit_factor(unit, si_unit)
    except ValueError as error:
        raise ValueError(f"{path}: column {column}: {error}") from error
    return Bound(name, column, header.index(column), factor, si_unit)


def _find_column(path: Path, header: Sequence[str], name: str, column: str | None) -> str:
    """The column mapped to a channel: by its whole header, or by the name in a header of the form name_unit."""
    wanted = column or name
    if wanted in header:
        return wanted
    names = {split[0]: h for h in header if (split := header_unit(h))}
    if wanted in names:
        return names[wanted]
    near = difflib.get_close_matches(wanted, [*header, *names], n=1, cutoff=0.5)
    hint = f"; the nearest is {names.get(near[0], near[0])}" if near else ""
    raise ValueError(
        f"{path}: expected a column for {name} ('{wanted}' or '{wanted}_UNIT'), got {', '.join(header)}{hint}; "
        f"map it under columns: {{{name}: {{column: ..., unit: ...}}}}"
    )


def _unit_in(path: Path, column: str) -> str:
    split = header_unit(column)
    if split is None:
        raise ValueError(
            f"{path}: column {column}: expected a header of the form name_unit such as h1_cm, got no unit in it; "
            f"give the unit under columns: {{...: {{column: {column}, unit: cm}}}}"
        )
    return split[1]


def positions_of(bounds: Sequence[Bound]) -> list[int]:
    """The columns of the file that are read, each once, in the order of their first use."""
    return list(dict.fromkeys(b.position for b in bounds if b.position is not None))


def _read_table(
    path: Path, handle: TextIO, header: Sequence[str], delimiter: str, line: int, positions: list[int]
) -> np.ndarray:
    """The wanted columns as (rows, columns) float64; missing cells are NaN."""
    blocks = []
    for lines in _blocks(path, handle):
        try:
            blocks.append(_parse_fast(lines, delimiter, positions, len(header)))
        except ValueError:
            blocks.append(parse_carefully(path, lines, header, delimiter, line, positions))
        line += len(lines)
    table = np.concatenate(blocks) if blocks else np.empty((0, len(positions)))
    if len(table) < 2:
        raise ValueError(f"{path}: expected at least two rows of numbers, got {len(table)}")
    return table


def _blocks(path: Path, handle: TextIO) -> Iterator[list[str]]:
    try:
        while lines := list(islice(handle, LINES_PER_BLOCK)):
            yield lines
    except (UnicodeDecodeError, EOFError, gzip.BadGzipFile) as error:
        raise ValueError(f"{path}: expected a whole CSV file, got one that is cut off or damaged: {error}") from error


def _parse_fast(lines: list[str], delimiter: str, positions: list[int], width: int) -> np.ndarray:
    """Well-formed lines, in C. Raises ValueError for anything else."""
    if any(line.count(delimiter) != width - 1 for line in lines):
        raise ValueError("uneven rows")
    return np.loadtxt(lines, delimiter=delimiter, usecols=positions, ndmin=2, comments=None)


def parse_carefully(
    path: Path, lines: list[str], header: Sequence[str], delimiter: str, line: int, positions: list[int]
) -> np.ndarray:
    """Cell by cell: knows missing cells, and names the one that is wrong."""
    rows = []
    for number, cells in enumerate(csv.reader(lines, delimiter=delimiter), start=line + 1):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise ValueError(f"{path}: row {number}: expected {len(header)} cells as in the header, got {len(cells)}")
        rows.append([_number(path, number, header[p], cells[p]) for p in positions])
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(positions))


def _number(path: Path, row: int, column: str, cell: str) -> float:
    text = cell.strip()
    if text.lower() in MISSING_WORDS:
        return float("nan")
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"{path}: row {row}, column {column}: expected a number or an empty cell, got '{text}'"
        ) from None


def _clock(path: Path, seconds: np.ndarray, clock: Bound, header_line: int) -> np.ndarray:
    seconds = seconds * clock.factor
    if not np.isfinite(seconds).all():
        row = header_line + 1 + int(np.flatnonzero(~np.isfinite(seconds))[0])
        raise ValueError(f"{path}: row {row}, column {clock.header}: expected a time in every row, got none")
    back = np.flatnonzero(np.diff(seconds) <= 0)
    if len(back):
        before, after = seconds[back[0]], seconds[back[0] + 1]
        rows = "one such row" if len(back) == 1 else f"{len(back)} such rows"
        raise ValueError(
            f"{path}: row {header_line + 2 + int(back[0])}, column {clock.header}: expected time that increases, got "
            f"{after:g} s after {before:g} s ({rows}); sort the rows or drop the repeated ones"
        )
    return seconds


def channels_in_si(table: np.ndarray, positions: list[int], bounds: Sequence[Bound]) -> np.ndarray:
    """The bound channels in SI as (rows, channels); what is not finite becomes NaN."""
    channels = np.empty((len(table), len(bounds)))
    for i, bound in enumerate(bounds):
        source = bound.constant if bound.position is None else table[:, positions.index(bound.position)]
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
