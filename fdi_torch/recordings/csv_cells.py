"""The cells of a CSV file: numbers with a decimal point or comma, words for bad values, and time stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fdi_torch.recordings.csv_text import Heading, rows_of
from fdi_torch.recordings.time_stamps import StampReader, seconds_of

BAD = float("inf")
"""The value of a cell that reports a bad reading; an empty cell, where nothing was logged, is NaN."""
BAD_WORDS = frozenset(
    {"nan", "na", "n/a", "null", "none", "-", "--", "---", "bad", "bad input", "no data", "invalid", "error", "err"}
    | {"#n/a", "#div/0!", "#value!", "#ref!", "#num!", "#name?", "#null!"}
    | {"i/o timeout", "timeout", "comm fail", "no result", "pt created", "scan off", "not connect", "shutdown"}
    | {"calc failed", "configure", "over range", "under range", "out of serv", "offline", "disconnected"}
)
GOOD_WORDS = frozenset({"good", "ok", "valid", "g", "192", "0xc0", "0x00c0", "good, non-specific", "0x000000c0"})
"""Quality words of valid values; 192 is OPC's."""


@dataclass(frozen=True)
class Rule:
    """The meaning of words that stand in a column in place of numbers.

    words: lower-case text -> value in the column's unit, BAD for a bad reading. quality: position of the column with
    the quality of the value; good: its words for a valid value.
    """

    words: Mapping[str, float] = field(default_factory=dict)
    quality: int | None = None
    good: frozenset[str] = GOOD_WORDS


@dataclass(frozen=True)
class Columns:
    """The columns to read, by position, with their rules.

    stamps: the column with time stamps, read by `read_stamp`. sparse: whether empty cells differ from cells that report
    a bad value.
    """

    path: Path
    heading: Heading
    positions: list[int]
    stamps: int | None = None
    read_stamp: StampReader = seconds_of
    rules: Mapping[int, Rule] = field(default_factory=dict)
    sparse: bool = False


def parse_fast(lines: list[str], columns: Columns) -> np.ndarray:
    """Parse well-formed lines in C into (rows, columns) float64. Raises ValueError for anything else."""
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
    """Parse cell by cell: empty cells are NaN, bad ones BAD; errors name row and column. above: lines before these."""
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
    return apply_rule(cells[position], None if rule.quality is None else cells[rule.quality], rule, delimiter)


def apply_rule(cell: str, quality: str | None, rule: Rule, delimiter: str) -> float:
    """The number in a cell, given the rule of its column and its quality."""
    text = cell.strip().lower()
    if text and quality is not None and quality.strip().lower() not in rule.good:
        return BAD
    if text in rule.words:
        return rule.words[text]
    number = number_in(cell, delimiter)
    return next((value for word, value in rule.words.items() if _is_number(word, number)), number)


def _is_number(word: str, number: float) -> bool:
    """Whether a word has that value, as -9999 has that of -9999.0."""
    try:
        return float(word) == number
    except ValueError:
        return False


def number_in(cell: str, delimiter: str) -> float:
    """The number in a cell: NaN if empty, BAD for a word of `BAD_WORDS`. Raises ValueError for other text."""
    text = cell.strip()
    if not text:
        return float("nan")
    if text.lower() in BAD_WORDS:
        return BAD
    if delimiter != "," and "." not in text:
        text = text.replace(",", ".")
    expected = f"expected a number or an empty cell, got '{cell.strip()}'"
    try:
        number = float(text)
    except ValueError:
        fix = f"say what it means, as in words: {{{text}: null}} for what does not count"
        fix = "write it with a point, as in 1180.5" if "," in text else fix
        raise ValueError(f"{expected}; {fix}") from None
    # float() also accepts the digits of other scripts and underscores; np.loadtxt of `parse_fast` does not.
    if not text.isascii() or "_" in text:
        raise ValueError(f"{expected}; write it with the digits 0 to 9 and without underscores")
    return number
