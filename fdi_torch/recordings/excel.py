"""The rows of a sheet of an Excel workbook. The only importer of openpyxl (extra `excel`)."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path

from fdi_torch.names import unknown
from fdi_torch.outside import MOST_SHEET, MOST_SHEET_EXPANSION, expect_unpacked
from fdi_torch.recordings.tables import Row
from fdi_torch.tables import needed

_BOOK = "xl/workbook.xml"


def rows(path: Path, sheet: str | None) -> Iterator[Row]:
    """The rows of the sheet (the first one where None), formulas as the values that Excel last had of them."""
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(part.file_size for part in archive.infolist())
        names = archive.namelist()
    if _BOOK not in names:
        raise ValueError(f"{path}: expected a CSV, MCAP or Excel file (.xlsx), got another zip archive; unpack it")
    expect_unpacked(unpacked, path.stat().st_size, str(path), MOST_SHEET, MOST_SHEET_EXPANSION)
    needed("defusedxml", "excel")  # without it, entities of a hostile workbook could be spelled out endlessly
    openpyxl = needed("openpyxl", "excel")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of styles and extensions, which are not read
        book = openpyxl.load_workbook(path, read_only=True, data_only=True, keep_links=False)
        try:
            there = [each.title for each in book.worksheets]
            if sheet is not None and sheet not in there:
                raise ValueError(f"{path}: sheet: {unknown('a sheet', sheet, there)}")
            table = book[sheet or there[0]]
            table.reset_dimensions()  # what other programs say of a sheet's size may be wrong, and rows would be lost
            yield from table.iter_rows(values_only=True)
        finally:
            book.close()
