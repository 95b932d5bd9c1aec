"""The datasets of an HDF5 file, or of a MATLAB file of version 7.3, as a table. Needs h5py (extra `hdf5`)."""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any

from fdi_torch.recordings.table_files import Row, expect_cells, rows_of_arrays
from fdi_torch.tables import needed

MOST_DATASETS = 10_000


def rows(path: Path, sheet: str | None) -> Iterator[Row]:
    """Numeric datasets of the greatest length, one column each, named by their path (`run/h1_cm`).

    Links into other files are not followed, and datasets stored in other files are not read.
    """
    h5py = needed("h5py", "hdf5")
    with h5py.File(path, "r") as file:
        datasets: dict[str, Any] = {}
        visited = 0

        def collect(name: str, item: Any) -> None:
            nonlocal visited
            visited += 1
            if visited > MOST_DATASETS:
                raise ValueError(f"{path}: expected at most {MOST_DATASETS} groups and datasets, got more")
            external = isinstance(item, h5py.Dataset) and (item.is_virtual or item.external is not None)
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiub" and not external and item.ndim in (1, 2):
                datasets[name] = item

        file.visititems(collect)
        expect_cells(path, sum(max(int(item.size), prod(item.chunks or ())) for item in datasets.values()))
        arrays = {name: item[()] for name, item in datasets.items()}
        if "MATLAB_class" in {key for item in datasets.values() for key in item.attrs}:
            arrays = {name: array.T for name, array in arrays.items()}  # MATLAB stores columns as rows
    yield from rows_of_arrays(path, arrays)
