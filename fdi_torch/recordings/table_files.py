"""Tables in formats other than CSV, converted to the text of an equivalent CSV file.

All rules and error messages for headers, units, time stamps and cells are thus those of CSV. A format is one entry of
`FORMATS` and a module with a generator `rows(path, sheet)` of a header and then rows of plain values.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import date, datetime
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from fdi_torch.untrusted_input import MOST_EXPANSION, MOST_LINE, MOST_UNPACKED, expect_unpacked

Row = Sequence[object]
DELIMITER = "\t"
BYTES_A_CELL = 8
_AT_ONCE = 256  # rows between two checks of the size


@dataclass(frozen=True)
class Format:
    """A file format, recognised by its first bytes. module: its reader in this package."""

    magic: bytes
    name: str
    module: str


FORMATS = (
    Format(b"PAR1", "a Parquet file", "arrow"),
    Format(b"ARROW1", "a Feather file", "arrow"),
    Format(b"PK\x03\x04", "an Excel workbook", "excel"),
    Format(b"MATLAB 5.0", "a MATLAB file", "matlab"),
    Format(b"\x89HDF", "an HDF5 file", "hdf5"),
    Format(b"MATLAB 7.3", "an HDF5 file", "hdf5"),
)


def format_of(beginning: bytes) -> Format | None:
    """The format of a file with these first bytes; None for text."""
    return next((known for known in FORMATS if beginning.startswith(known.magic)), None)


def table_text(path: Path, known: Format, sheet: str | None) -> TableText:
    """The table in a file of that format. sheet: of a workbook; None for the first."""
    if sheet is not None and known.module != "excel":
        raise ValueError(f"{path}: sheet: expected this key of an Excel workbook only, got {known.name}; leave it out")
    reader = import_module(f"fdi_torch.recordings.{known.module}")
    return TableText(path, known, reader.rows(path, sheet))


class TableText(io.TextIOBase):
    """The lines of a table as tab-separated text, produced a few rows ahead of the reader.

    Raises ValueError, naming the file, if the content is damaged or exceeds the allowed expansion.
    """

    delimiter = DELIMITER
    encoding = "utf-8"

    def __init__(self, path: Path, known: Format, rows: Iterator[Row]) -> None:
        self._path, self._known = path, known
        self._rows = rows
        self._lines = self._text_lines()

    def readable(self) -> bool:
        return True

    def readline(self, size: int | None = -1, /) -> str:  # type: ignore[override]
        return next(self._lines, "")

    def close(self) -> None:
        with closing(self._lines):
            super().close()

    def _text_lines(self) -> Generator[str, None, None]:
        packed, cells, width = self._path.stat().st_size, 0, 0
        while block := self._next_rows():
            cells += sum(map(len, block))
            expect_unpacked(BYTES_A_CELL * cells, packed, str(self._path), MOST_UNPACKED, MOST_EXPANSION)
            width = width or max(len(_trimmed(row)) for row in block)
            yield from _lines(_of_width(row, width) for row in block)

    def _next_rows(self) -> list[Row]:
        try:
            return list(islice(self._rows, _AT_ONCE))
        except MemoryError:
            raise
        except ImportError as error:
            raise ValueError(f"{self._path}: {error}") from None
        except Exception as error:  # libraries raise many types for a damaged file
            if isinstance(error, ValueError) and str(error).startswith(str(self._path)):
                raise
            reason = str(error).partition("\n")[0] or type(error).__name__
            what = f"{self._path}: expected {self._known.name} that is whole, got one that cannot be read"
            raise ValueError(f"{what}: {reason}") from error


def expect_cells(path: Path, cells: int) -> None:
    """Raises ValueError, before reading, if a file claims more cells than its size allows."""
    expect_unpacked(BYTES_A_CELL * cells, path.stat().st_size, str(path), MOST_UNPACKED, MOST_EXPANSION)


def _lines(rows: Iterable[Row]) -> list[str]:
    text = io.StringIO()
    csv.writer(text, delimiter=DELIMITER, lineterminator="\n").writerows(
        [_cell(value) for value in row] for row in rows
    )
    return text.getvalue().splitlines(keepends=True)


def tab_separated(rows: Iterator[Row]) -> Iterator[list[str]]:
    """Rows of plain values as lines of tab-separated text, in blocks; the first row is the header."""
    while block := list(islice(rows, _AT_ONCE)):
        yield _lines(block)


def _trimmed(row: Row) -> Row:
    """The row without trailing empty cells."""
    last = next((k for k in range(len(row), 0, -1) if row[k - 1] not in (None, "")), 0)
    return row[:last]


def _of_width(row: Row, width: int) -> Row:
    """The row extended or cut to the header's width by empty cells; unchanged if non-empty cells exceed it."""
    if len(row) < width:
        return [*row, *[None] * (width - len(row))]
    return row if any(value not in (None, "") for value in row[width:]) else row[:width]


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, int | float):
        return "" if value != value else repr(float(value)) if isinstance(value, float) else str(value)
    if isinstance(value, datetime | date):
        return value.isoformat()
    text = value if isinstance(value, str) else str(value)
    if len(text) > MOST_LINE:
        raise ValueError(f"expected cells of at most {MOST_LINE} characters, got more")
    return " ".join(text.split()) if any(c in text for c in "\t\r\n\v\f\x1c\x1d\x1e\x85\u2028\u2029") else text


def rows_of_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> Iterator[Row]:
    """A header and rows from the arrays of the greatest length.

    A vector NAME is one column, a matrix (rows, k) the columns NAME:1 to NAME:k; folders are dropped from the names if
    they stay unique. Raises ValueError if there are no such arrays.
    """
    tables = {
        name: array.reshape(-1, 1) if 1 in array.shape or array.ndim == 1 else array for name, array in arrays.items()
    }
    length = max((len(table) for table in tables.values() if table.ndim == 2), default=0)
    columns: dict[str, np.ndarray] = {}
    for name, table in tables.items():
        if table.ndim == 2 and len(table) == length:
            is_matrix = table.shape[1] > 1
            columns |= {
                f"{name}:{k + 1}" if is_matrix else name: table[:, k].astype(np.float64) for k in range(table.shape[1])
            }
    if length < 2:
        raise ValueError(f"{path}: expected vectors of numbers of one length, got {', '.join(arrays) or 'none'}")
    short = [name.rpartition("/")[2] for name in columns]
    yield short if len(set(short)) == len(short) else list(columns)
    yield from zip(*(column.tolist() for column in columns.values()), strict=True)
