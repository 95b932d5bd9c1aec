"""The recurrences of `scan.py` and `midpoint.py` as compiled loops over time.

Compiled at the first use for each number of tanks, up to MOST, because the loops keep matrices of a block of steps on
the stack. The functions return None without a compiler or for tensors that loops cannot take (gradients, float32, GPU);
the callers then do the same with torch, many times slower.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.simulate.build import BuildError, load_library

MOST = 32
_SOURCE = Path(__file__).with_name("recurrence.hpp")


def compiled_scan(
    a: Float[Tensor, "L n n K"],
    b: Float[Tensor, "L n m K"],
    first: Float[Tensor, "L n m"],
    gain: Float[Tensor, "L n n K"] | None = None,
) -> Float[Tensor, "L n m K+1"] | None:
    """x_{k+1} = A_k x_k + G_k b_k: a and gain (L, n, n, K), b (L, n, m, K), first (L, n, m) -> x (L, n, m, K+1)."""
    if not _plain(a, b, first, *(() if gain is None else (gain,))):
        return None
    lanes, n, columns, steps = b.shape
    x = b.new_empty(lanes, n, columns, steps + 1)
    return x if _run("scan_in_time", b.shape, [a, gain, b, first], [x]) else None


def midpoint_step(
    span: Tensor, path: Tensor, rates: Tensor, by_level: Tensor, by_theta: Tensor, start: Tensor, start_slopes: Tensor
) -> tuple[Tensor, ...] | None:
    """As `midpoint.newton_step`, or None."""
    inputs = [span, path, rates, by_level, by_theta, start, start_slopes]
    if not _plain(*inputs):
        return None
    lanes, n, columns, steps = by_theta.shape
    slopes, defect = path.new_empty(lanes, n, columns, steps + 1), path.new_empty(lanes)
    outputs = [torch.empty_like(path), slopes, torch.empty_like(by_level), torch.empty_like(by_level), defect]
    return tuple(outputs) if _run("midpoint_step", by_theta.shape, inputs, outputs) else None


def midpoint_correction(
    span: Tensor, path: Tensor, rates: Tensor, by_level: Tensor, start: Tensor
) -> tuple[Tensor, Tensor] | None:
    """As `midpoint.newton_correction`, or None."""
    inputs = [span, path, rates, by_level, None, start, None]
    if not _plain(span, path, rates, by_level, start):
        return None
    lanes, n, steps = rates.shape
    levels, defect = torch.empty_like(path), path.new_empty(lanes)
    shape = torch.Size((lanes, n, 0, steps))
    return (levels, defect) if _run("midpoint_step", shape, inputs, [levels, None, None, None, defect]) else None


def _plain(*tensors: Tensor) -> bool:
    """Whether all tensors are float64 numbers on the CPU without gradients."""
    return not any(t.requires_grad or t.dtype is not torch.float64 or t.device.type != "cpu" for t in tensors)


def _run(name: str, shape: torch.Size, inputs: Sequence[Tensor | None], outputs: Sequence[Tensor | None]) -> bool:
    """Run one of the loops; False without a compiled library. shape: (L, n, columns, K). given: inputs; made:
    outputs.
    """
    lanes, n, columns, steps = shape
    library = _library(n) if n <= MOST else None
    if library is None:
        return False
    contiguous = [None if t is None else t.contiguous() for t in inputs]
    pointers = [ctypes.c_void_p(None if t is None else t.data_ptr()) for t in (*contiguous, *outputs)]
    getattr(library, name)(*(ctypes.c_int64(x) for x in (lanes, steps, columns)), *pointers)
    return True


@lru_cache
def _library(tanks: int) -> ctypes.CDLL | None:
    try:
        source = f"#define TANKS {tanks}\n" + _SOURCE.read_text(encoding="utf-8")
        return load_library(source, "scan_in_time", "midpoint_step")
    except BuildError:
        return None
