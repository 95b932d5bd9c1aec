"""The rows of a sheet of an Excel workbook. The only importer of openpyxl (extra `excel`)."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path

from fdi_torch.names import unknown
from fdi_torch.recordings.table_files import Row
from fdi_torch.tables import needed
from fdi_torch.untrusted_input import MOST_SHEET, MOST_SHEET_EXPANSION, expect_unpacked

_BOOK = "xl/workbook.xml"


def rows(path: Path, sheet: str | None) -> Iterator[Row]:
    """The rows of the sheet (default: the first), with the last computed values of formulas."""
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(part.file_size for part in archive.infolist())
        names = archive.namelist()
    if _BOOK not in names:
        raise ValueError(f"{path}: expected a CSV, MCAP or Excel file (.xlsx), got another zip archive; unpack it")
    expect_unpacked(unpacked, path.stat().st_size, str(path), MOST_SHEET, MOST_SHEET_EXPANSION)
    needed("defusedxml", "excel")  # protects against the endless entity expansion of a hostile workbook
    openpyxl = needed("openpyxl", "excel")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about styles and extensions, which are not read
        book = openpyxl.load_workbook(path, read_only=True, data_only=True, keep_links=False)
        try:
            titles = [each.title for each in book.worksheets]
            if sheet is not None and sheet not in titles:
                raise ValueError(f"{path}: sheet: {unknown('a sheet', sheet, titles)}")
            table = book[sheet or titles[0]]
            table.reset_dimensions()  # sizes written by other programs may be wrong, and rows would be lost
            yield from table.iter_rows(values_only=True)
        finally:
            book.close()
