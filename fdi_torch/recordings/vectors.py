"""Named arrays as the columns of a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from fdi_torch.recordings.table_files import Row


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
