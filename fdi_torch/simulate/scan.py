"""A linear recurrence in time: a compiled loop, or some vector operations on all K steps.

The loops are compiled at the first use for each number of tanks, up to `MOST`, because they keep matrices of a block of
steps on the stack. Without a compiler, and for tensors that they cannot take (gradients, float32, GPU), torch does the
same many times slower.
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


def scan_in_time(
    a: Float[Tensor, "L n n K"],
    b: Float[Tensor, "L n m K"],
    first: Float[Tensor, "L n m"],
    gain: Float[Tensor, "L n n K"] | None = None,
) -> Float[Tensor, "L n m K+1"]:
    """x_{k+1} = A_k x_k + b_k for k = 0..K-1: a (L, n, n, K), b (L, n, m, K), first (L, n, m) -> x (L, n, m, K+1).

    gain: G (L, n, n, K), if the forcing is G_k b_k. Without a compiled loop, each state follows from that 1, 2, 4 ...
    steps before it, with the products of the A between them (Hillis and Steele, 1986).
    """
    count = b.shape[-1]
    a, x = a.expand(b.shape[0], *a.shape[1:]), b.new_empty(*b.shape[:-1], count + 1)
    if run_loop("scan_in_time", b.shape, [a, gain, b, first], [x]):
        return x
    if gain is not None:
        b = product(gain, b)
    x = torch.cat([product(a[..., :1], first.unsqueeze(-1)) + b[..., :1], b[..., 1:]], dim=-1)
    reach = 1
    while reach < count:
        later, between = x[..., reach:] + product(a[..., reach:], x[..., :-reach]), a[..., reach:]
        a = torch.cat([a[..., :reach], product(between, a[..., :-reach])], dim=-1)
        x, reach = torch.cat([x[..., :reach], later], dim=-1), 2 * reach
    return torch.cat([first.unsqueeze(-1), x], dim=-1)


def product(a: Float[Tensor, "L n n K"], x: Float[Tensor, "L n m K"]) -> Float[Tensor, "L n m K"]:
    """a (L, n, n, K) times x (L, n, m, K) at every step, as an explicit sum: bitwise equal alone and in a batch."""
    total = a[:, :, 0, None] * x[:, None, 0]
    for j in range(1, a.shape[2]):
        total.addcmul_(a[:, :, j, None], x[:, None, j])
    return total


def run_loop(name: str, shape: torch.Size, inputs: Sequence[Tensor | None], outputs: Sequence[Tensor | None]) -> bool:
    """Run a loop of recurrence.hpp, which fills the outputs; False where it cannot. shape: (L, n, columns, K)."""
    lanes, n, columns, steps = shape
    library = _library(n) if n <= MOST and all(t is None or is_plain(t) for t in inputs) else None
    if library is None:
        return False
    contiguous = [None if t is None else t.contiguous() for t in inputs]
    pointers = [ctypes.c_void_p(None if t is None else t.data_ptr()) for t in (*contiguous, *outputs)]
    getattr(library, name)(*(ctypes.c_int64(x) for x in (lanes, steps, columns)), *pointers)
    return True


def is_plain(tensor: Tensor) -> bool:
    """Whether a tensor holds float64 numbers on the CPU without gradients."""
    return not tensor.requires_grad and tensor.dtype is torch.float64 and tensor.device.type == "cpu"


@lru_cache
def _library(tanks: int) -> ctypes.CDLL | None:
    try:
        source = f"#define TANKS {tanks}\n" + _SOURCE.read_text(encoding="utf-8")
        return load_library(source, "scan_in_time", "midpoint_step")
    except BuildError:
        return None
