"""The recurrences of `scan.py` and `midpoint.py` as compiled loops: one walk through time instead of many operations.

Compiled at the first use and once a machine, for any plant of up to MOST tanks. None where there is no compiler, or
for tensors that loops over numbers cannot take: torch does the same then, many times slower.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from fdi_torch.simulate.build import BuildError, load_library

MOST = 6
_SOURCE = Path(__file__).with_name("recurrence.hpp")


def scanned(a: Tensor, b: Tensor, first: Tensor) -> Tensor | None:
    """x_{k+1} = A_k x_k + b_k: a (L, n, n, K), b (L, n, m, K), first (L, n, m) -> x (L, n, m, K+1)."""
    if not _plain(a, b, first):
        return None
    lanes, n, columns, steps = b.shape
    x = b.new_empty(lanes, n, columns, steps + 1)
    return x if _run("scan_in_time", b.shape, [a, b, first], [x]) else None


def midpoint_step(
    span: Tensor, path: Tensor, rates: Tensor, by_level: Tensor, by_theta: Tensor, start: Tensor, start_slopes: Tensor
) -> tuple[Tensor, ...] | None:
    """As `midpoint.newton_step`, which says what these are."""
    given = [span, path, rates, by_level, by_theta, start, start_slopes]
    if not _plain(*given):
        return None
    lanes, n, columns, steps = by_theta.shape
    slopes, defect = path.new_empty(lanes, n, columns, steps + 1), path.new_empty(lanes)
    made = [torch.empty_like(path), slopes, torch.empty_like(by_level), torch.empty_like(by_level), defect]
    return tuple(made) if _run("midpoint_step", by_theta.shape, given, made) else None


def _plain(*given: Tensor) -> bool:
    """Whether all of these are nothing but numbers, of the kind that was compiled for."""
    return not any(t.requires_grad or t.dtype is not torch.float64 or t.device.type != "cpu" for t in given)


def _run(name: str, shape: torch.Size, given: list[Tensor], made: list[Tensor]) -> bool:
    """Runs one of the loops. shape: (L, n, columns, K). given: is read as it lies there; made: is written."""
    lanes, n, columns, steps = shape
    library = _library() if n <= MOST else None
    if library is None:
        return False
    held = [t.contiguous() for t in given]
    pointers = [ctypes.c_void_p(t.data_ptr()) for t in (*held, *made)]
    getattr(library, name)(*(ctypes.c_int64(x) for x in (n, lanes, steps, columns)), *pointers)
    return True


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL | None:
    try:
        return load_library(_SOURCE.read_text(encoding="utf-8"))
    except BuildError:
        return None
