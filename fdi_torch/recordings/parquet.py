"""The rows of a Parquet file (pyarrow, extra `parquet`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fdi_torch.recordings.table_files import Row, expect_cells
from fdi_torch.tables import needed

ROWS_AT_ONCE = 1 << 14


def rows(path: Path, sheet: str | None) -> Iterator[Row]:
    """The names of the columns, then the rows; time stamps as datetimes, to the microsecond."""
    needed("pyarrow", "parquet")
    parquet = needed("pyarrow.parquet", "parquet")
    schema = parquet.ParquetFile(path).schema_arrow
    # Repeated texts are read as indices into a dictionary, which saves memory.
    texts = [field.name for field in schema if str(field.type) in ("string", "large_string")]
    file = parquet.ParquetFile(path, read_dictionary=texts)
    names = [str(name) for name in schema.names]
    expect_cells(path, file.metadata.num_rows * len(names))
    yield names
    for batch in file.iter_batches(ROWS_AT_ONCE):
        yield from zip(*(plain_values(column) for column in batch.columns), strict=True)


def plain_values(column: Any) -> list[Any]:
    """A column as plain values; for nested types the name of the type, which is then rejected as a number."""
    pyarrow = needed("pyarrow", "parquet")
    kind = column.type
    if pyarrow.types.is_dictionary(kind):
        entries, places = column.dictionary.to_pylist(), column.indices.to_pylist()
        return [None if place is None else entries[place] for place in places]
    if pyarrow.types.is_timestamp(kind):
        return list(column.cast(pyarrow.timestamp("us", kind.tz), safe=False).to_pylist())
    known = pyarrow.types
    if known.is_string(kind) or known.is_large_string(kind):
        return list(column.to_pylist())
    plain = (known.is_integer, known.is_floating, known.is_decimal, known.is_boolean, known.is_date, known.is_null)
    return list(column.to_pylist()) if any(each(kind) for each in plain) else [f"({kind})"] * len(column)
