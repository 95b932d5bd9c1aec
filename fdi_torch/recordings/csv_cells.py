"""The cells of a CSV file: numbers with a point or a comma, cells that say that nothing was read, time stamps."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fdi_torch.recordings.csv_text import Heading

MISSING_WORDS = frozenset(
    {"", "nan", "na", "n/a", "null", "none", "-", "bad", "bad input", "no data"}
    | {"#n/a", "#div/0!", "#value!", "#ref!", "#num!", "#name?", "#null!"}
)


@dataclass(frozen=True)
class Columns:
    """Which columns (positions) are read, and which of them holds time stamps instead of numbers."""

    path: Path
    heading: Heading
    positions: list[int]
    stamps: int | None = None


def parse_fast(lines: list[str], columns: Columns) -> np.ndarray:
    """Well-formed lines, in C, as (rows, columns) float64. Raises ValueError for anything else."""
    delimiter, width = columns.heading.delimiter, len(columns.heading.names)
    if any(line.count(delimiter) != width - 1 for line in lines):
        raise ValueError("uneven rows")
    if delimiter != ",":
        lines = [line.replace(",", ".") for line in lines]
    stamps: dict[int | str, Callable[[str], Any]] = {} if columns.stamps is None else {columns.stamps: seconds_of}
    return np.loadtxt(
        lines,
        delimiter=delimiter,
        usecols=columns.positions,
        ndmin=2,
        comments=None,
        converters=stamps,
        encoding="utf-8",
    )


def parse_carefully(lines: list[str], columns: Columns, above: int) -> np.ndarray:
    """Cell by cell: knows missing cells (NaN), and names the wrong one. above: lines of the file before these."""
    return np.array(list(_rows(lines, columns, above)), dtype=np.float64).reshape(-1, len(columns.positions))


def _rows(lines: list[str], columns: Columns, above: int) -> Iterator[list[float]]:
    names, delimiter = columns.heading.names, columns.heading.delimiter
    for number, cells in enumerate(csv.reader(lines, delimiter=delimiter), start=above + 1):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(names):
            raise ValueError(
                f"{columns.path}: row {number}: expected {len(names)} cells as in the header, got {len(cells)}"
            )
        row = []
        for p in columns.positions:
            try:
                row.append(seconds_of(cells[p]) if p == columns.stamps else _number(cells[p], delimiter))
            except ValueError as error:
                raise ValueError(f"{columns.path}: row {number}, column {names[p]}: {error}") from None
        yield row


def _number(cell: str, delimiter: str) -> float:
    text = cell.strip()
    if text.lower() in MISSING_WORDS:
        return float("nan")
    if delimiter != "," and "." not in text:
        text = text.replace(",", ".")
    try:
        return float(text)
    except ValueError:
        hint = "; write it with a point, as in 1180.5" if "," in text else ""
        raise ValueError(f"expected a number or an empty cell, got '{cell.strip()}'{hint}") from None


def seconds_of(stamp: str) -> float:
    """An ISO 8601 time stamp in seconds since 1970; one without an offset is taken for UTC. NaN for an empty cell."""
    text = stamp.strip().strip('"')
    if not text:
        return float("nan")
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(
            f"expected a time stamp such as 2026-03-29T08:30:00 or 2026-03-29 08:30:00.25+01:00, got '{text}'; "
            "write it so, or as numbers under a header such as t_s"
        ) from None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
