"""A linear recurrence in time: a compiled loop, or a few dozen vector operations on blocks of blocks for all K
steps.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.simulate.recurrence import compiled_scan

LENGTH = 8  # sequential steps in each block, and in blocks of blocks


def linear_scan(
    transition: Float[Tensor, "L K n n"], forcing: Float[Tensor, "L K n m"], first: Float[Tensor, "L n m"]
) -> Float[Tensor, "L K+1 n m"]:
    """x_{k+1} = A_k x_k + b_k for k = 0..K-1.

    transition (L, K, n, n), forcing (L, K, n, m), first (L, n, m) -> x (L, K+1, n, m), with time last in memory.
    """
    a, b = transition.permute(0, 2, 3, 1), forcing.permute(0, 2, 3, 1)
    return scan_in_time(a, b, first).permute(0, 3, 1, 2)


def scan_in_time(
    a: Float[Tensor, "L n n K"],
    b: Float[Tensor, "L n m K"],
    first: Float[Tensor, "L n m"],
    gain: Float[Tensor, "L n n K"] | None = None,
) -> Float[Tensor, "L n m K+1"]:
    """`linear_scan` with time last: a (L, n, n, K), b (L, n, m, K), first (L, n, m) -> (L, n, m, K+1).

    gain: G (L, n, n, K), if the forcing is G_k b_k. Without a compiled loop, all blocks run in parallel from zero
    together with the products of their A; the starts of the blocks obey such a recurrence again, and then every x
    follows.
    """
    m, count = b.shape[2], b.shape[-1]
    a = a.expand(b.shape[0], *a.shape[1:])
    if (compiled := compiled_scan(a, b, first, gain)) is not None:
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
