"""A linear recurrence in time, solved in blocks: about 2 sqrt(K) vector operations instead of K."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def linear_scan(transition: Tensor, forcing: Tensor, first: Tensor) -> Tensor:
    """x_{k+1} = A_k x_k + b_k for k = 0..K-1.

    transition (L, K, n, n), forcing (L, K, n, m), first (L, n, m) -> x (L, K+1, n, m). All blocks run side by side
    from zero, with the product of their A; the blocks' starts follow, and then every x.
    """
    lanes, count, n, m = forcing.shape
    length = max(1, math.isqrt(count))
    blocks = -(-count // length)
    a = _in_blocks(transition.expand(lanes, count, n, n), blocks, length, torch.eye(n, dtype=first.dtype))
    b = _in_blocks(forcing, blocks, length, first.new_zeros(n, m))
    inner = _side_by_side(a, b)
    starts = [first]
    for j in range(blocks - 1):
        end = inner[-1][:, j]
        starts.append(end[..., :m] + _times(end[..., m:], starts[-1]))
    start = torch.stack(starts, dim=1)
    path = torch.stack(inner, dim=2)  # (L, blocks, length, n, m + n)
    x = path[..., :m] + _times(path[..., m:], start.unsqueeze(2))
    return torch.cat([first.unsqueeze(1), x.reshape(lanes, blocks * length, n, m)[:, :count]], dim=1)


def _in_blocks(x: Tensor, blocks: int, length: int, filler: Tensor) -> Tensor:
    """(L, K, ...) -> (L, blocks, length, ...), the last block filled up."""
    missing = blocks * length - x.shape[1]
    if missing:
        x = torch.cat([x, filler.expand(x.shape[0], missing, *filler.shape)], dim=1)
    return x.reshape(x.shape[0], blocks, length, *x.shape[2:])


def _side_by_side(a: Tensor, b: Tensor) -> list[Tensor]:
    """Within each block: [x from zero | product of A] after each of its steps."""
    m = b.shape[-1]
    state = torch.cat([b[:, :, 0], a[:, :, 0]], dim=-1)
    found = [state]
    for k in range(1, a.shape[2]):
        state = _times(a[:, :, k], state)
        state[..., :m] += b[:, :, k]
        found.append(state)
    return found


def _times(a: Tensor, x: Tensor) -> Tensor:
    """a (..., n, n) times x (..., n, m) as an explicit sum: the same bits alone and in a batch."""
    total = a[..., :, :1] * x[..., :1, :]
    for j in range(1, a.shape[-1]):
        total = total + a[..., :, j : j + 1] * x[..., j : j + 1, :]
    return total
