"""The rows of a Feather file, which is an Arrow IPC file (pyarrow, extra `parquet`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fdi_torch.recordings.parquet import plain_values
from fdi_torch.recordings.table_files import Row, expect_cells
from fdi_torch.tables import needed


def rows(path: Path, sheet: str | None) -> Iterator[Row]:
    """The names of the columns, then the rows; time stamps as datetimes, to the microsecond."""
    needed("pyarrow", "parquet")
    claimed = needed("pyarrow.dataset", "parquet").dataset(path, format="ipc").count_rows()
    with needed("pyarrow.ipc", "parquet").open_file(path.read_bytes()) as file:
        names = [str(name) for name in file.schema.names]
        expect_cells(path, claimed * len(names))
        yield names
        for k in range(file.num_record_batches):
            batch = file.get_batch(k)
            batch.validate(full=True)  # a damaged file may point beyond its buffers
            yield from zip(*(plain_values(column) for column in batch.columns), strict=True)
