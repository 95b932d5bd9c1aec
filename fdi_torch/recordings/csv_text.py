"""The text of a CSV file, as loggers, spreadsheets and historians write it: its encoding, delimiter and headers."""

from __future__ import annotations

import codecs
import csv
import gzip
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TextIO

from fdi_torch.parameters import header_unit, si_unit_of

_SNIFFED = 1 << 16
_FOREIGN = {
    b"PK\x03\x04": "a zip archive or an Excel workbook; save the sheet as CSV",
    b"PAR1": "a Parquet file; write it as CSV",
    b"\x89HDF": "an HDF5 or MATLAB file; write its channels as CSV",
    b"MATLAB 5.0": "a MATLAB file; write its channels as CSV",
    b"\x89MCAP": "an MCAP file; let its name end in .mcap",
}


@dataclass(frozen=True)
class Heading:
    """Column names, the delimiter, and how many lines of the file they and what stands above them take."""

    names: tuple[str, ...]
    delimiter: str
    lines: int


def open_csv(path: Path) -> TextIO:
    """UTF-8 or UTF-16, or else what Western European Windows writes. Raises ValueError for what is no text."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a CSV file, got none there; check the path")
    encoding = _encoding(path, _beginning(path))
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding=encoding, newline="")
    return path.open(encoding=encoding, newline="")


def _beginning(path: Path) -> bytes:
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as raw:
            return raw.read(_SNIFFED)
    except EOFError:
        return b""  # cut off; which the reader says
    except gzip.BadGzipFile as error:
        raise ValueError(f"{path}: expected a CSV file (plain or .gz), got something else: {error}") from error


def _encoding(path: Path, start: bytes) -> str:
    for magic, what in _FOREIGN.items():
        if start.startswith(magic):
            raise ValueError(f"{path}: expected a CSV or MCAP file, got {what}")
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if b"\0" in start:
        raise ValueError(f"{path}: expected a CSV or MCAP file, got something that is no text")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def heading_of(path: Path, lines: Iterable[str]) -> tuple[Heading, Iterator[str]]:
    """The heading, and the lines below it. Lines that start with # may stand above, and Excel's `sep=;`; a row of units
    may stand below names without units.
    """
    rest, delimiter = iter(lines), ""
    for number, line in enumerate(rest, start=1):
        if line.lower().startswith("sep=") and len(line.strip()) == 5:
            delimiter = line[4]
        elif line.strip() and not line.startswith("#"):
            names = _cells(line, delimiter or max(",;\t", key=line.count))
            if len(names) < 2:
                raise ValueError(
                    f"{path}: row {number}: expected a header line such as t_s,Q1_cm3_s,h1_cm, got "
                    f"'{line.strip()[:60]}'; put # before what stands above the header, and part columns by commas"
                )
            return _with_units(names, delimiter or max(",;\t", key=line.count), number, rest)
    raise ValueError(f"{path}: expected a header line such as t_s,Q1_cm3_s,h1_cm, got an empty file")


def _with_units(names: list[str], delimiter: str, number: int, rest: Iterator[str]) -> tuple[Heading, Iterator[str]]:
    below = next(rest, None)
    if below is None:
        return Heading(tuple(names), delimiter, number), rest
    units = _cells(below, delimiter)
    bare = len(units) == len(names) and all(
        not unit or not header_unit(n) for n, unit in zip(names, units, strict=True)
    )
    if bare and any(units) and all(not unit or _is_unit(unit) for unit in units):
        named = tuple(f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True))
        return Heading(named, delimiter, number + 1), rest
    return Heading(tuple(names), delimiter, number), chain([below], rest)


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]


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
