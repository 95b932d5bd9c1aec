"""The text of a CSV file as loggers, spreadsheets and historians write it: encoding, delimiter, header, and the units
in it.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, TextIO

from fdi_torch.quantities import si_unit_of
from fdi_torch.recordings.table_files import TableText, format_of, table_text
from fdi_torch.units import MOST_CHARACTERS
from fdi_torch.untrusted_input import MOST_EXPANSION, MOST_LINE, MOST_UNPACKED, expect_unpacked


@lru_cache(maxsize=1024)
def header_unit(header: str) -> tuple[str, str] | None:
    """Split a CSV header of the form name_unit, name [unit], name (unit), name in unit or name / unit:
    'Q1_cm3_s' -> ('Q1', 'cm3_s'); None without a unit.

    The shortest name followed by a unit wins: `qL_cmd_lps` is (`qL_cmd`, `lps`), `Q1_cm3_s` is (`Q1`, `cm3_s`).
    `tank_A` is a name without unit: write amperes as mA, or in brackets.
    """
    cuts = [i for i in range(max(0, len(header) - MOST_CHARACTERS - 1), len(header)) if header[i] == "_"]
    splits = [
        (name.rstrip(), unit.strip()) for name, _, unit in (header.rpartition(s) for s in (" in ", " / ")) if name
    ]
    splits += [(header[:i], header[i + 1 :]) for i in cuts if header[i + 1 :] != "A"]
    for name, unit in [bracketed] if (bracketed := _bracketed(header)) else splits:
        try:
            si_unit_of(unit)
        except ValueError:
            continue
        return name, unit
    return None


def names_in(header: Sequence[str]) -> set[str]:
    """What a channel may be called: whole headers, and names of headers with a unit."""
    return {*header, *(split[0] for column in header if (split := header_unit(column)))}


def _bracketed(header: str) -> tuple[str, str] | None:
    opening = {"]": "[", ")": "("}.get(header[-1:])
    place = header.rfind(opening) if opening else -1
    return (header[:place].rstrip(" \t_"), header[place + 1 : -1].strip()) if place > 0 else None


_SNIFFED = 1 << 16
_FOREIGN = {
    b"FEA1": "a Feather file of version 1; write it as version 2",
    b"\x89MCAP": "an MCAP file; let its name end in .mcap",
}


@dataclass(frozen=True)
class Heading:
    """Column names, the delimiter, and the number of lines up to and including the header.

    date: position of a column of dates that the file has beside one of times of day; here both are one column.
    """

    names: tuple[str, ...]
    delimiter: str
    lines: int
    date: int | None = None


def open_csv(path: Path, sheet: str | None = None) -> TextIO | TableText:
    """The text of a CSV file in UTF-8, UTF-16 or Windows-1252; or a table of another format in the same form.

    sheet: of an Excel workbook. Raises ValueError for any other content.
    """
    if not path.is_file():
        raise ValueError(f"{path}: file not found; check the path")
    beginning = _beginning(path)
    if known := format_of(beginning):
        return table_text(path, known, sheet)
    if sheet is not None:
        raise ValueError(f"{path}: sheet: expected this key of an Excel workbook only, got a CSV file; leave it out")
    encoding = _encoding(path, beginning)
    errors = "strict" if encoding == "utf-16" else WINDOWS
    if path.suffix == ".gz":
        return io.TextIOWrapper(io.BufferedReader(_Unpacked(path)), encoding, errors, newline="")
    return path.open(encoding=encoding, errors=errors, newline="")


WINDOWS = "windows-1252"
"""Error handler that reads bytes which are not UTF-8 as Windows-1252, also far from the beginning of a file."""


def _in_windows(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeDecodeError)
    return error.object[error.start : error.end].decode("cp1252", "replace"), error.end


codecs.register_error(WINDOWS, _in_windows)


class _Unpacked(io.RawIOBase):
    """The bytes of a .gz file, up to the allowed expansion."""

    def __init__(self, path: Path) -> None:
        self._path, self._packed, self._count = path, path.stat().st_size, 0
        self._file = gzip.open(path)  # noqa: SIM115, closed with this

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        chunk = self._file.read(len(buffer))
        buffer[: len(chunk)] = chunk
        self._count += len(chunk)
        expect_unpacked(self._count, self._packed, str(self._path), MOST_UNPACKED, MOST_EXPANSION)
        return len(chunk)

    def close(self) -> None:
        self._file.close()
        super().close()


def rows_of(path: Path, lines: Iterable[str], delimiter: str, above: int = 0) -> Iterator[tuple[int, list[str]]]:
    """The cells of each line with the number of its row; above: rows of the file before these."""
    rows = csv.reader(lines, delimiter=delimiter)
    number = above
    try:
        for number, cells in enumerate(rows, start=above + 1):
            yield number, cells
    except csv.Error as error:
        raise ValueError(
            f"{path}: row {number + 1}: expected cells of a CSV file, got something else: {error}"
        ) from None


def _short_lines(path: Path, lines: Iterable[str]) -> Iterator[str]:
    for number, line in enumerate(lines, start=1):
        if len(line) > MOST_LINE:
            raise ValueError(
                f"{path}: row {number}: expected at most {MOST_LINE} characters in a line, got more; is it a CSV file?"
            )
        yield line


def _beginning(path: Path) -> bytes:
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as raw:
            return raw.read(_SNIFFED)
    except EOFError:
        return b""  # cut off; the reader reports it
    except (gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path}: expected a CSV file (plain or .gz), got something else: {error}") from None


def _encoding(path: Path, start: bytes) -> str:
    foreign = next((what for magic, what in _FOREIGN.items() if start.startswith(magic)), None)
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if foreign or b"\0" in start:
        got = foreign or "something that is not text"
        raise ValueError(f"{path}: expected a CSV, MCAP, Parquet, Feather, Excel, MATLAB or HDF5 file, got {got}")
    return "utf-8-sig"


class HeaderlessError(ValueError):
    """A table without a header, read as if it had one."""


def heading_of(path: Path, lines: Iterable[str], header: bool = True) -> tuple[Heading, Iterator[str]]:
    """The heading, and an iterator over the lines below it.

    Lines that start with #, Excel's `sep=;`, and titles may precede the header; a row of units may follow names
    without units. A title is a row with one cell.
    header: False if the file has none; columns are then named by their numbers 1, 2 ..., and the data begin in the
    first row with a number that has as many cells as the row below it.
    """
    remaining: Iterator[str] = _short_lines(path, lines)
    separator, number, title = getattr(lines, "delimiter", ""), 0, "an empty file"
    while (line := next(remaining, None)) is not None:
        number += 1
        if line.lower().startswith("sep=") and len(line.strip()) == 5:
            separator = line[4]
        elif line.strip() and not line.startswith("#"):
            delimiter = separator or _delimiter(line, header)
            names = _cells(path, line, delimiter, number - 1)
            if header and _ALL_NUMBERS.fullmatch(line):
                raise HeaderlessError(
                    f"{path}: row {number}: expected a header line such as t_s,Q1_cm3_s,h1_cm, got numbers; for a file "
                    "without one, write header: false, and number the columns: columns: {h1: {column: 4, unit: mm}}"
                )
            if header and sum(map(bool, names)) > 1:
                return _with_units(path, names, delimiter, number, remaining)
            if not header and any(_BEGINS_AS_NUMBER.match(name) for name in names):
                below = next(remaining, None)
                remaining = chain([] if below is None else [below], remaining)
                if below is None or len(_cells(path, below, delimiter, number)) == len(names):
                    numbers = tuple(str(k + 1) for k in range(len(names)))
                    return Heading(numbers, delimiter, number - 1), chain([line], remaining)
            if title == "an empty file":
                title = f"'{line.strip()[:60]}'"
    expected = "a header line such as t_s,Q1_cm3_s,h1_cm" if header else "a row of numbers"
    raise ValueError(f"{path}: expected {expected}, got {title}; separate columns by commas, semicolons or tabs")


_BEGINS_AS_NUMBER = re.compile(r"[+-]?[.,]?\d")  # also time stamps
_ALL_NUMBERS = re.compile(r"(?=.*\d)[\d\s.,;:+\-eE]+", re.DOTALL)  # also time stamps


def _delimiter(line: str, header: bool) -> str:
    """The delimiter of the columns. In a row of numbers, a comma beside tabs or semicolons is a decimal comma."""
    if header:
        return max("\t;,", key=line.count)  # as many commas stand in the names
    return next((each for each in "\t;" if each in line), ",")


def _with_units(
    path: Path, names: list[str], delimiter: str, number: int, remaining: Iterator[str]
) -> tuple[Heading, Iterator[str]]:
    """The heading, with the units of a second row if it is one; and the remaining lines."""
    first = next(remaining, None)
    cells = [] if first is None else _cells(path, first, delimiter, number)
    bare = len(cells) == len(names) and all(
        not unit or not header_unit(n) for n, unit in zip(names, cells, strict=True)
    )
    if bare and any(cells) and all(not unit or _is_unit(unit) for unit in cells):
        names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, cells, strict=True)]
        number, first = number + 1, next(remaining, None)
        cells = [] if first is None else _cells(path, first, delimiter, number)
    dated = (k for k, (a, b) in enumerate(pairwise(cells)) if _DATE.fullmatch(a) and _TIME_OF_DAY.fullmatch(b))
    date = next(dated, None)
    if date is not None and date + 1 < len(names):
        names[date : date + 2] = [f"{names[date]} {names[date + 1]}"]
    heading = Heading(tuple(names), delimiter, number, date)
    return heading, joined(remaining if first is None else chain([first], remaining), heading)


# A workbook writes a date with the time of day 00:00:00.
_DATE = re.compile(r"(\d{1,4}[./-]\d{1,2}[./-]\d{1,4})(?:[T ]00:00:00)?", re.ASCII)
_TIME_OF_DAY = re.compile(r"\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d+)?)?(?: ?[AaPp][Mm])?", re.ASCII)


def joined(lines: Iterable[str], heading: Heading) -> Iterator[str]:
    """The lines of a file with its dates and times of day, if they are two columns, as one column of time stamps."""
    if heading.date is None:
        yield from lines
        return
    for line in lines:
        cells = line.split(heading.delimiter)
        if len(cells) < heading.date + 2:
            yield line
            continue
        before, (date, time, *after) = cells[: heading.date], cells[heading.date :]
        ending = time[len(time.rstrip("\r\n")) :]
        bare = [cell.strip().strip('"') for cell in (date, time)]
        match = _DATE.fullmatch(bare[0])
        stamp = f"{match[1] if match else bare[0]} {bare[1]}".strip() + ending
        yield heading.delimiter.join([*before, stamp, *after])


def _cells(path: Path, line: str, delimiter: str, above: int) -> list[str]:
    return [cell.strip() for _, cells in rows_of(path, [line], delimiter, above) for cell in cells]


def _is_unit(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        pass
    else:
        return False
    try:
        si_unit_of(text)
    except ValueError:
        return False
    return True
