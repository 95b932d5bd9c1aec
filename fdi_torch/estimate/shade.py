"""Success-history adaptation of F and CR, and the archive of replaced parents, as in L-SHADE.

Tanabe & Fukunaga (2014), "Improving the search performance of SHADE using linear population size reduction",
section II; numbers in square brackets are equations of that paper. A CR memory cell with the terminal value, stored as
-1, yields CR = 0 from then on.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fdi_torch.estimate.batch_algebra import row_sum

TERMINAL = -1.0
_SPREAD = 0.1


def draw_rate(memory: Float[Tensor, "*batch"], u: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Draw CR ~ normal(memory, 0.1), clamped to [0, 1]; 0 from a terminal cell. u: uniform draws. [1]"""
    normal = math.sqrt(2.0) * torch.erfinv(2.0 * u - 1.0)
    return torch.where(memory == TERMINAL, 0.0, (memory + _SPREAD * normal).clamp(0.0, 1.0))


def draw_factor(memory: Float[Tensor, "*batch"], u: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Draw F ~ Cauchy(memory, 0.1), conditional on F > 0, limited to 1. u: uniform draws. [2]

    The paper redraws until F > 0. The inverse distribution function of the truncated distribution needs no loop.
    """
    below_zero = 0.5 - torch.atan(memory / _SPREAD) / math.pi
    probability = below_zero + u * (1.0 - below_zero)
    return (memory + _SPREAD * torch.tan(math.pi * (probability - 0.5))).clamp(1e-12, 1.0)


def lehmer_mean(values: Float[Tensor, "*batch N"], weights: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
    """Weighted Lehmer mean sum w S^2 / sum w S over the last dimension; 0 if sum w S is 0. [7]"""
    weighted = weights * values
    denominator = row_sum(weighted)
    return torch.where(
        denominator > 0, row_sum(weighted * values) / torch.where(denominator > 0, denominator, 1.0), 0.0
    )


def success_weights(gain: Float[Tensor, "*batch N"], success: Bool[Tensor, "*batch N"]) -> Float[Tensor, "*batch N"]:
    """Weights of the successful candidates: improvement of the cost relative to the largest finite one.

    Candidates without success have weight 0; a parent of infinite cost counts as the largest finite gain. The weights
    are not normalised to a sum of 1, because a common factor cancels in the Lehmer mean.
    """
    finite = success & torch.isfinite(gain)
    largest = torch.where(finite, gain, 0.0).amax(-1, keepdim=True)
    largest = torch.where(largest > 0, largest, 1.0)
    return torch.where(finite, gain / largest, success.to(gain.dtype))


def update_memory(
    memory_f: Float[Tensor, "*problems H"],
    memory_cr: Float[Tensor, "*problems H"],
    cell: Int[Tensor, "*problems"],
    factor: Float[Tensor, "*problems N"],
    rate: Float[Tensor, "*problems N"],
    gain: Float[Tensor, "*problems N"],
    success: Bool[Tensor, "*problems N"],
) -> tuple[Float[Tensor, "*problems H"], Float[Tensor, "*problems H"], Int[Tensor, "*problems"]]:
    """Store the weighted mean of the successful F and CR in one cell of the memories (*problems, H). [Algorithm 1]

    cell (*problems): index of the cell, which advances cyclically. factor, rate, gain (parent's minus candidate's cost)
    and success are (*problems, N). A problem without success is not changed. Returns both memories and the next cell.
    """
    weights = success_weights(gain, success)
    any_success = success.any(-1)
    at = cell[..., None]
    terminal = (memory_cr.gather(-1, at)[..., 0] == TERMINAL) | (torch.where(success, rate, 0.0).amax(-1) == 0.0)
    new_f, mean_cr = lehmer_mean(torch.stack([factor, rate]), weights.expand(2, *weights.shape))
    new_cr = torch.where(terminal, TERMINAL, mean_cr)
    memory_f = torch.where(any_success[..., None], memory_f.scatter(-1, at, new_f[..., None]), memory_f)
    memory_cr = torch.where(any_success[..., None], memory_cr.scatter(-1, at, new_cr[..., None]), memory_cr)
    return memory_f, memory_cr, torch.where(any_success, (cell + 1) % memory_f.shape[-1], cell)


def update_archive(
    archive: Float[Tensor, "*problems A P"],
    filled: Int[Tensor, "*problems"],
    parents: Float[Tensor, "*problems N P"],
    success: Bool[Tensor, "*problems N"],
    u: Float[Tensor, "*problems N"],
) -> tuple[Float[Tensor, "*problems A P"], Int[Tensor, "*problems"]]:
    """Add replaced parents to the archive, each in the next free row, or in a random row once the archive is full.

    archive (*problems, A, P), of which the first `filled` (*problems) rows are in use; parents (*problems, N, P);
    success (*problems, N); u (*problems, N): uniform random numbers. Returns the new archive and count.
    """
    capacity = archive.shape[-2]
    entry = torch.arange(parents.shape[-2], device=u.device).expand(success.shape)
    free = filled[..., None] + success.cumsum(-1) - 1
    target_row = torch.where(free < capacity, free, (u * capacity).long())
    # If several parents have the same target row, only the last one is written, so the result is deterministic.
    last = entry.new_full((*filled.shape, capacity), -1)
    last = last.scatter_reduce(-1, target_row.clamp(min=0), torch.where(success, entry, -1), "amax")
    is_written = success & (last.gather(-1, target_row.clamp(min=0)) == entry)
    problem = torch.arange(filled.numel(), device=u.device).reshape(*filled.shape, 1)
    row = (problem * capacity + target_row)[is_written]
    rows = archive.reshape(-1, archive.shape[-1]).index_copy(0, row, parents[is_written])
    return rows.reshape(archive.shape), (filled + success.sum(-1)).clamp(max=capacity)
