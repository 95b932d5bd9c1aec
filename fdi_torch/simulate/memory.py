"""Memories of whole signals at once: m_{k+1} = F_k(m_k), solved by Newton over all k, with forward-mode tangents."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.autograd import forward_ad

from fdi_torch.plant.effect import Memory
from fdi_torch.simulate.scan import linear_scan

ROUNDS = 40
SETTLED = 1e-11
Step = Callable[[Memory], tuple[list[Tensor], Memory]]


def recur(step: Step, first: Memory, shape: Sequence[int]) -> tuple[Tensor, Tensor]:
    """step(memory before each of K steps, (L, K)) -> (outputs, memory after each), first (L, 1), shape (L, K).

    Returns the memory before each step (L, K, n) and its slope over each step (L, K, n, n). One round where F is
    linear in the memory.
    """
    start = torch.stack([m.expand(*shape[:-1], 1) for m in first], -1)
    guess = start.expand(*shape, len(first)).clone()
    for _ in range(ROUNDS):
        after, slopes = _slopes(step, guess)
        scale = guess.abs().max() + 1e-12
        defect = torch.cat([guess[..., :1, :] - start, guess[..., 1:, :] - after[..., :-1, :]], dim=-2)
        if float(defect.abs().max() / scale) < SETTLED:
            break
        forcing = (after - (slopes * guess.unsqueeze(-2)).sum(-1)).unsqueeze(-1)
        guess = linear_scan(slopes, forcing, start.transpose(-1, -2))[:, :-1, :, 0]
    return guess, slopes


def with_tangents(step: Step, first: Memory, guess: Tensor, slopes: Tensor, count: int) -> list[Tensor]:
    """The outputs as duals: step's signals are duals (count, L, K), the memory's path (L, K, n) is known.

    Tangents obey t_{k+1} = slopes_k t_k + dF_k, the same for each of the `count` directions.
    """
    size, shape = guess.shape[-1], guess.shape[:-1]
    none = guess.new_zeros(count, *shape)
    plain = tuple(m.expand(count, *shape) for m in guess.unbind(-1))
    moved = [forward_ad.unpack_dual(a).tangent for a in step(plain)[1]]
    forcing = torch.stack([none if t is None else t.expand(count, *shape) for t in moved], -1)
    begun = [forward_ad.unpack_dual(m).tangent for m in first]
    begin = torch.stack([none[..., :1] if t is None else t.expand(count, shape[0], 1) for t in begun], -1)
    path = linear_scan(slopes, forcing.permute(1, 2, 3, 0), begin[..., 0, :].permute(1, 2, 0))[:, :-1]
    tangents = path.permute(3, 0, 1, 2)
    duals = tuple(forward_ad.make_dual(plain[i].contiguous(), tangents[..., i].contiguous()) for i in range(size))
    return step(duals)[0]


def _slopes(step: Step, guess: Tensor) -> tuple[Tensor, Tensor]:
    """Memory after (L, K, n) and its slope by the memory before (L, K, n, n), by finite differences."""

    def after(memory: Tensor) -> Tensor:
        return torch.stack([a.expand(guess.shape[:-1]) for a in step(memory.unbind(-1))[1]], -1)

    base = after(guess)
    columns = []
    for j in range(guess.shape[-1]):
        moved = guess.clone()
        width = 1e-4 * (guess[..., j].abs().max() + 1e-9)
        moved[..., j] += width
        columns.append((after(moved) - base) / width)
    return base, torch.stack(columns, -1)
