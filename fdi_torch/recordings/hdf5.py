"""The datasets of an HDF5 file, or of a MATLAB file of version 7.3, as a table. Needs h5py (extra `hdf5`)."""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any

from fdi_torch.recordings.tables import Row, expect_cells
from fdi_torch.recordings.vectors import rows_of_arrays
from fdi_torch.tables import needed

MOST_DATASETS = 10_000


def rows(path: Path, sheet: str | None) -> Iterator[Row]:
    """Datasets of numbers that are as long as the longest, a column each, by their path (`run/h1_cm`).

    Links into other files are not followed, and datasets that lie in other files are not read.
    """
    h5py = needed("h5py", "hdf5")
    with h5py.File(path, "r") as file:
        there: dict[str, Any] = {}
        visited = 0

        def look(name: str, item: Any) -> None:
            nonlocal visited
            visited += 1
            if visited > MOST_DATASETS:
                raise ValueError(f"{path}: expected at most {MOST_DATASETS} groups and datasets, got more")
            elsewhere = isinstance(item, h5py.Dataset) and (item.is_virtual or item.external is not None)
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiub" and not elsewhere and item.ndim in (1, 2):
                there[name] = item

        file.visititems(look)
        expect_cells(path, sum(max(int(item.size), prod(item.chunks or ())) for item in there.values()))
        arrays = {name: item[()] for name, item in there.items()}
        if "MATLAB_class" in {key for item in there.values() for key in item.attrs}:
            arrays = {name: array.T for name, array in arrays.items()}  # it writes columns as rows
    return rows_of_arrays(path, arrays)
