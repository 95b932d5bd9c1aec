"""The vectors and matrices of a MATLAB file (up to version 7) as a table, by SciPy."""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from pathlib import Path

from scipy.io import loadmat, whosmat

from fdi_torch.recordings.table_files import Row, expect_cells, rows_of_arrays

_NUMBERS = frozenset(
    {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
)


def rows(path: Path, sheet: str | None) -> Iterator[Row]:
    """Numeric variables of the greatest length, one column each; the columns of a matrix M are M:1 ..."""
    variables = [(name, shape) for name, shape, kind in whosmat(str(path), appendmat=False) if kind in _NUMBERS]
    expect_cells(path, sum(prod(shape) for _, shape in variables))
    arrays = loadmat(str(path), appendmat=False, variable_names=[name for name, _ in variables], squeeze_me=False)
    yield from rows_of_arrays(path, {name: arrays[name] for name, _ in variables})
