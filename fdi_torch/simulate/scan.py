"""A linear recurrence in time: a compiled loop, or else blocks of blocks, a few dozen vector operations for all K."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.simulate.recurrence import scanned

LENGTH = 8  # steps taken one after the other in each block, and in blocks of blocks


def linear_scan(transition: Tensor, forcing: Tensor, first: Tensor) -> Tensor:
    """x_{k+1} = A_k x_k + b_k for k = 0..K-1.

    transition (L, K, n, n), forcing (L, K, n, m), first (L, n, m) -> x (L, K+1, n, m), with time last in memory.
    """
    a, b = transition.permute(0, 2, 3, 1), forcing.permute(0, 2, 3, 1)
    return scan_in_time(a, b, first).permute(0, 3, 1, 2)


def scan_in_time(a: Tensor, b: Tensor, first: Tensor, gain: Tensor | None = None) -> Tensor:
    """The same with time last: a (L, n, n, K), b (L, n, m, K), first (L, n, m) -> (L, n, m, K+1).

    gain: G (L, n, n, K), where it is G_k b_k that is added.

    All blocks run side by side from zero, with the product of their A; the starts of the blocks are such a
    recurrence again, and then every x follows.
    """
    m, count = b.shape[2], b.shape[-1]
    a = a.expand(b.shape[0], *a.shape[1:])
    if (compiled := scanned(a, b, first, gain)) is not None:
        return compiled
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
    """(L, n, m, K) -> (LENGTH, L, n, m, blocks), the last block filled up with ones on the diagonal, or zeros."""
    lanes, n, m, count = x.shape
    whole, rest = divmod(count, LENGTH)
    found = x.new_empty(LENGTH, lanes, n, m, blocks)
    found[..., :whole] = x[..., : whole * LENGTH].unflatten(-1, (whole, LENGTH)).permute(4, 0, 1, 2, 3)
    if rest:
        found[:rest, ..., whole] = x[..., whole * LENGTH :].permute(3, 0, 1, 2)
        found[rest:, ..., whole] = torch.eye(n, m, dtype=x.dtype, device=x.device) if one else 0.0
    return found


def _side_by_side(a: Tensor, b: Tensor) -> list[Tensor]:
    """Within each block: [x from zero | product of A] after each of its steps, (L, n, m + n, blocks)."""
    m = b.shape[3]
    state = torch.cat([b[0], a[0]], dim=2)
    found = [state]
    for k in range(1, len(a)):
        state = product(a[k], state)
        state[:, :, :m] += b[k]
        found.append(state)
    return found


def _one_by_one(a: Tensor, b: Tensor, first: Tensor) -> list[Tensor]:
    found = [first]
    for k in range(b.shape[-1]):
        found.append(product(a[..., k : k + 1], found[-1].unsqueeze(-1))[..., 0] + b[..., k])
    return found


def product(a: Tensor, x: Tensor) -> Tensor:
    """a (L, n, n, K) times x (L, n, m, K) at every step, as an explicit sum: the same bits alone and in a batch."""
    total = a[:, :, 0, None] * x[:, None, 0]
    for j in range(1, a.shape[2]):
        total.addcmul_(a[:, :, j, None], x[:, None, j])
    return total
