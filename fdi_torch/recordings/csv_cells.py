"""The cells of a CSV file: numbers with a point or a comma, cells that say that nothing was read, time stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fdi_torch.recordings.csv_text import Heading, rows_of
from fdi_torch.recordings.stamps import seconds_of

BAD = float("inf")
"""A cell that says that nothing could be read, unlike an empty one (NaN), where nothing was logged."""
BAD_WORDS = frozenset(
    {"nan", "na", "n/a", "null", "none", "-", "--", "---", "bad", "bad input", "no data", "invalid", "error", "err"}
    | {"#n/a", "#div/0!", "#value!", "#ref!", "#num!", "#name?", "#null!"}
    | {"i/o timeout", "timeout", "comm fail", "no result", "pt created", "scan off", "not connect", "shutdown"}
    | {"calc failed", "configure", "over range", "under range", "out of serv", "offline", "disconnected"}
)
GOOD_WORDS = frozenset({"good", "ok", "valid", "g", "192", "0xc0", "0x00c0", "good, non-specific", "0x000000c0"})
"""What servers write beside a value that counts; 192 is OPC's."""


@dataclass(frozen=True)
class Rule:
    """What cells of a column mean beyond numbers. words: by lower case, in the column's unit; BAD where nothing was
    read. quality: position of the column that tells whether a value counts, `good` the words by which it does.
    """

    words: Mapping[str, float] = field(default_factory=dict)
    quality: int | None = None
    good: frozenset[str] = GOOD_WORDS


@dataclass(frozen=True)
class Columns:
    """Which columns (positions) are read, which of them holds time stamps instead of numbers and how these are read,
    and by which rules. sparse: whether an empty cell is another thing than one that says that nothing was read.
    """

    path: Path
    heading: Heading
    positions: list[int]
    stamps: int | None = None
    read_stamp: Callable[[str], float] = seconds_of
    rules: Mapping[int, Rule] = field(default_factory=dict)
    sparse: bool = False


def parse_fast(lines: list[str], columns: Columns) -> np.ndarray:
    """Well-formed lines, in C, as (rows, columns) float64. Raises ValueError for anything else."""
    delimiter, width = columns.heading.delimiter, len(columns.heading.names)
    if columns.rules or columns.sparse or any(line.count(delimiter) != width - 1 for line in lines):
        raise ValueError("uneven rows, or cells with more than numbers")
    if delimiter != ",":
        lines = [line.replace(",", ".") for line in lines]
    stamps: dict[int | str, Callable[[str], Any]] = {}
    if columns.stamps is not None:
        stamps = {columns.stamps: columns.read_stamp}
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
    """Cell by cell: knows empty cells (NaN) and bad ones (BAD), and names the wrong one. above: lines of the file
    before these.
    """
    return np.array(list(_rows(lines, columns, above)), dtype=np.float64).reshape(-1, len(columns.positions))


def _rows(lines: list[str], columns: Columns, above: int) -> Iterator[list[float]]:
    names, delimiter = columns.heading.names, columns.heading.delimiter
    for number, cells in rows_of(columns.path, lines, delimiter, above):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(names):
            raise ValueError(
                f"{columns.path}: row {number}: expected {len(names)} cells as in the header, got {len(cells)}"
            )
        row = []
        for p in columns.positions:
            try:
                row.append(columns.read_stamp(cells[p]) if p == columns.stamps else _value(cells, p, columns))
            except ValueError as error:
                raise ValueError(f"{columns.path}: row {number}, column {names[p]}: {error}") from None
        yield row


def _value(cells: list[str], position: int, columns: Columns) -> float:
    """The number in a cell by its column's rule."""
    rule, delimiter = columns.rules.get(position), columns.heading.delimiter
    if rule is None:
        return number_in(cells[position], delimiter)
    return ruled(cells[position], None if rule.quality is None else cells[rule.quality], rule, delimiter)


def ruled(cell: str, quality: str | None, rule: Rule, delimiter: str) -> float:
    """The number in a cell, given what its column's words mean and how good it is said to be."""
    text = cell.strip().lower()
    if text and quality is not None and quality.strip().lower() not in rule.good:
        return BAD
    if text in rule.words:
        return rule.words[text]
    number = number_in(cell, delimiter)
    return next((value for word, value in rule.words.items() if _is_number(word, number)), number)


def _is_number(word: str, number: float) -> bool:
    """Whether a word is that number, as -9999 is -9999.0."""
    try:
        return float(word) == number
    except ValueError:
        return False


def number_in(cell: str, delimiter: str) -> float:
    text = cell.strip()
    if not text:
        return float("nan")
    if text.lower() in BAD_WORDS:
        return BAD
    if delimiter != "," and "." not in text:
        text = text.replace(",", ".")
    try:
        return float(text)
    except ValueError:
        fix = f"say what it means, as in words: {{{text}: null}} for what does not count"
        fix = "write it with a point, as in 1180.5" if "," in text else fix
        raise ValueError(f"expected a number or an empty cell, got '{cell.strip()}'; {fix}") from None
