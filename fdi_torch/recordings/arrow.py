"""The rows of a Parquet or Feather file, as Apache Arrow reads them (pyarrow, extra `parquet`)."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import repeat
from pathlib import Path
from typing import Any

from fdi_torch.recordings.table_files import Row, expect_cells
from fdi_torch.tables import needed
from fdi_torch.untrusted_input import MOST_EXPANSION, MOST_UNPACKED, expect_unpacked

FEATHER = b"ARROW1"
ROWS_AT_ONCE = 1 << 14
_TEXTS = ("string", "large_string")


def rows(path: Path, sheet: str | None) -> Iterator[Row]:
    """The names of the columns, then the rows; time stamps as datetimes, to the microsecond.

    Columns of nested types and of bytes are not unpacked: each cell is the name of the type, which is then rejected
    as a number.
    """
    needed("pyarrow", "parquet")
    with path.open("rb") as file:
        yield from (_feather_rows if file.read(len(FEATHER)) == FEATHER else _parquet_rows)(path)


def _feather_rows(path: Path) -> Iterator[Row]:
    claimed = needed("pyarrow.dataset", "parquet").dataset(path, format="ipc").count_rows()
    with needed("pyarrow.ipc", "parquet").open_file(path.read_bytes()) as file:
        names = [str(name) for name in file.schema.names]
        expect_cells(path, claimed * len(names))
        yield names
        for k in range(file.num_record_batches):
            batch = file.get_batch(k)
            batch.validate(full=True)  # a damaged file may point beyond its buffers
            yield from zip(*(plain_values(column) for column in batch.columns), strict=True)


def _parquet_rows(path: Path) -> Iterator[Row]:
    parquet = needed("pyarrow.parquet", "parquet")
    schema = parquet.ParquetFile(path).schema_arrow
    # Repeated texts are read as indices into a dictionary, which saves memory.
    texts = [field.name for field in schema if str(field.type) in _TEXTS]
    file = parquet.ParquetFile(path, read_dictionary=texts)
    names = [str(name) for name in schema.names]
    readable = [field.name for field in schema if _is_readable(field.type)]
    expect_cells(path, file.metadata.num_rows * len(names))
    expect_unpacked(
        _unpacked_bytes(file.metadata, set(readable)), path.stat().st_size, str(path), MOST_UNPACKED, MOST_EXPANSION
    )
    yield names
    for batch in file.iter_batches(ROWS_AT_ONCE, columns=readable):
        columns = iter(batch.columns)
        yield from zip(
            *(
                plain_values(next(columns)) if _is_readable(field.type) else repeat(f"({field.type})", batch.num_rows)
                for field in schema
            ),
            strict=True,
        )


def _unpacked_bytes(metadata: Any, names: set[str]) -> int:
    """The size of these columns once decompressed, as the file states it."""
    groups = (metadata.row_group(k) for k in range(metadata.num_row_groups))
    chunks = (group.column(k) for group in groups for k in range(group.num_columns))
    return sum(chunk.total_uncompressed_size for chunk in chunks if chunk.path_in_schema in names)


def _is_readable(kind: Any) -> bool:
    """True for texts, dictionaries, time stamps and plain numbers."""
    known = needed("pyarrow", "parquet").types
    plain = (known.is_integer, known.is_floating, known.is_decimal, known.is_boolean, known.is_date, known.is_null)
    return str(kind) in _TEXTS or any(each(kind) for each in (*plain, known.is_dictionary, known.is_timestamp))


def plain_values(column: Any) -> list[Any]:
    """A column as plain values; for other kinds the name of the kind, which is then rejected as a number."""
    if not _is_readable(column.type):
        return [f"({column.type})"] * len(column)
    pyarrow = needed("pyarrow", "parquet")
    kind = column.type
    if pyarrow.types.is_dictionary(kind):
        entries, places = column.dictionary.to_pylist(), column.indices.to_pylist()
        return [None if place is None else entries[place] for place in places]
    if pyarrow.types.is_timestamp(kind):
        return list(column.cast(pyarrow.timestamp("us", kind.tz), safe=False).to_pylist())
    return list(column.to_pylist())
