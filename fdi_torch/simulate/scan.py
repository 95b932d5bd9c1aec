"""A linear recurrence in time: a compiled loop, or a few dozen vector operations on blocks of blocks for all K steps.

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

LENGTH = 8  # sequential steps in each block, and in blocks of blocks
MOST = 32
_SOURCE = Path(__file__).with_name("recurrence.hpp")


def scan_in_time(
    a: Float[Tensor, "L n n K"],
    b: Float[Tensor, "L n m K"],
    first: Float[Tensor, "L n m"],
    gain: Float[Tensor, "L n n K"] | None = None,
) -> Float[Tensor, "L n m K+1"]:
    """x_{k+1} = A_k x_k + b_k for k = 0..K-1: a (L, n, n, K), b (L, n, m, K), first (L, n, m) -> x (L, n, m, K+1).

    gain: G (L, n, n, K), if the forcing is G_k b_k. Without a compiled loop, all blocks run in parallel from zero
    together with the products of their A; the starts of the blocks obey such a recurrence again, and then every x
    follows.
    """
    m, count = b.shape[2], b.shape[-1]
    a, x = a.expand(b.shape[0], *a.shape[1:]), b.new_empty(*b.shape[:-1], count + 1)
    if run_loop("scan_in_time", b.shape, [a, gain, b, first], [x]):
        return x
    if gain is not None:
        b = product(gain, b)
    if count <= LENGTH:
        return torch.stack(_one_by_one(a, b, first), dim=-1)
    blocks = -(-count // LENGTH)
    inner = _side_by_side(_in_blocks(a, blocks, one=True), _in_blocks(b, blocks, one=False))
    ends = inner[-1][..., :-1]
    start = scan_in_time(ends[:, :, m:], ends[:, :, :m], first)
    x = b.new_empty(*b.shape[:-1], blocks * LENGTH + 1)
    x[..., 0] = first
    steps = x[..., 1:].unflatten(-1, (blocks, LENGTH))
    for k, y in enumerate(inner):
        steps[..., k] = product(y[:, :, m:], start).add_(y[:, :, :m])
    return x[..., : count + 1]


def _in_blocks(x: Tensor, blocks: int, one: bool) -> Tensor:
    """(L, n, m, K) -> (LENGTH, L, n, m, blocks), the last block padded with identity matrices (`one`) or zeros."""
    lanes, n, m, count = x.shape
    whole, remainder = divmod(count, LENGTH)
    blocked = x.new_empty(LENGTH, lanes, n, m, blocks)
    blocked[..., :whole] = x[..., : whole * LENGTH].unflatten(-1, (whole, LENGTH)).permute(4, 0, 1, 2, 3)
    if remainder:
        blocked[:remainder, ..., whole] = x[..., whole * LENGTH :].permute(3, 0, 1, 2)
        blocked[remainder:, ..., whole] = torch.eye(n, m, dtype=x.dtype, device=x.device) if one else 0.0
    return blocked


def _side_by_side(a: Tensor, b: Tensor) -> list[Tensor]:
    """[x from zero | product of A] after each step within each block, (L, n, m + n, blocks)."""
    m = b.shape[3]
    state = torch.cat([b[0], a[0]], dim=2)
    states = [state]
    for k in range(1, len(a)):
        state = product(a[k], state)
        state[:, :, :m] += b[k]
        states.append(state)
    return states


def _one_by_one(a: Tensor, b: Tensor, first: Tensor) -> list[Tensor]:
    states = [first]
    for k in range(b.shape[-1]):
        states.append(product(a[..., k : k + 1], states[-1].unsqueeze(-1))[..., 0] + b[..., k])
    return states


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
