"""Memories of whole signals at once: m_{k+1} = F_k(m_k), solved by Newton over all k, with forward-mode tangents."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.autograd import forward_ad

from fdi_torch.plant.effect import Memory
from fdi_torch.simulate.scan import linear_scan

ROUNDS = 40
Step = Callable[[Memory], tuple[list[Tensor], Memory]]


def recur(step: Step, first: Memory, shape: Sequence[int]) -> tuple[list[Tensor], Memory]:
    """step(memory before each of K steps, (*lanes, K)) -> (outputs, memory after each).

    first: the memory before step 0, (*lanes, 1). shape: (*lanes, K). Exact after one round where F is linear in the
    memory; duals pass through, for their tangents obey the same linear recurrence.
    """
    lanes = shape[:-1]
    starts = [forward_ad.unpack_dual(m.expand(*lanes, 1)) for m in first]
    start = torch.stack([s.primal for s in starts], -1)
    guess = start.expand(*shape, len(first)).clone()
    for _ in range(ROUNDS):
        after, slopes = _slopes(step, guess)
        corrected = _scan(slopes, after - (slopes * guess.unsqueeze(-2)).sum(-1), start)
        change, guess = (corrected - guess).abs().max() / (guess.abs().max() + 1e-12), corrected
        if float(change) < 1e-12:
            break
    moved = [forward_ad.unpack_dual(a).tangent for a in step(guess.unbind(-1))[1]]
    if all(t is None for t in moved):
        return step(guess.unbind(-1))
    none = torch.zeros_like(guess[..., 0])
    forcing = torch.stack([none if t is None else t.expand(shape) for t in moved], -1)
    begin = torch.stack([none[..., :1] if s.tangent is None else s.tangent for s in starts], -1)
    tangents = _scan(slopes, forcing, begin)
    return step(
        tuple(
            forward_ad.make_dual(g.contiguous(), t.contiguous())
            for g, t in zip(guess.unbind(-1), tangents.unbind(-1), strict=True)
        )
    )


def _slopes(step: Step, guess: Tensor) -> tuple[Tensor, Tensor]:
    """Memory after (*lanes, K, n) and its slope by the memory before (*lanes, K, n, n), by finite differences."""

    def after(memory: Tensor) -> Tensor:
        found = [forward_ad.unpack_dual(a).primal.expand(guess.shape[:-1]) for a in step(memory.unbind(-1))[1]]
        return torch.stack(found, -1)

    base = after(guess)
    columns = []
    for j in range(guess.shape[-1]):
        moved = guess.clone()
        width = 1e-4 * (guess[..., j].abs().max() + 1e-9)
        moved[..., j] += width
        columns.append((after(moved) - base) / width)
    return base, torch.stack(columns, -1)


def _scan(slopes: Tensor, forcing: Tensor, start: Tensor) -> Tensor:
    """The memory before each step, (*lanes, K, n)."""
    lanes, n = forcing.shape[:-2], forcing.shape[-1]
    flat = [
        x.reshape(-1, *x.shape[len(lanes) :]) for x in (slopes, forcing.unsqueeze(-1), start[..., 0, :].unsqueeze(-1))
    ]
    path = linear_scan(*flat)[:, :-1, :, 0]
    return path.reshape(*lanes, forcing.shape[-2], n)
