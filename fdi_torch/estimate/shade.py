"""Success-history adaptation: memory of F and CR that worked, and the archive of beaten parents.

Tanabe & Fukunaga (2014), "Improving the search performance of SHADE using linear population size reduction",
section II; numbers in brackets are that paper's. CR's terminal value, of a memory cell that gives 0 from then on, is
written as -1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from fdi_torch.estimate.batch_algebra import row_sum

TERMINAL = -1.0
_SPREAD = 0.1


def draw_rate(memory: Tensor, u: Tensor) -> Tensor:
    """CR ~ normal(memory, 0.1), cut to [0, 1]; 0 from a terminal cell. memory, uniform draws u (...). [1]"""
    normal = math.sqrt(2.0) * torch.erfinv(2.0 * u - 1.0)
    return torch.where(memory == TERMINAL, 0.0, (memory + _SPREAD * normal).clamp(0.0, 1.0))


def draw_factor(memory: Tensor, u: Tensor) -> Tensor:
    """F ~ Cauchy(memory, 0.1), drawn again while F <= 0, cut to 1. memory, uniform draws u (...). [2]

    Drawing again until F > 0 is drawing from the part of the distribution above 0: no loop is needed.
    """
    below_zero = 0.5 - torch.atan(memory / _SPREAD) / math.pi
    share = below_zero + u * (1.0 - below_zero)
    return (memory + _SPREAD * torch.tan(math.pi * (share - 0.5))).clamp(1e-12, 1.0)


def lehmer_mean(values: Tensor, weights: Tensor) -> Tensor:
    """sum w S^2 / sum w S over the last dimension, (..., N) -> (...); 0 where sum w S is 0. [7]"""
    weighted = weights * values
    below = row_sum(weighted)
    return torch.where(below > 0, row_sum(weighted * values) / torch.where(below > 0, below, 1.0), 0.0)


def success_weights(gain: Tensor, success: Tensor) -> Tensor:
    """Improvement of the cost as a share of the largest: (..., N), 0 where there was no success.

    The common factor cancels in the mean. A parent of infinite cost counts as the largest finite gain.
    """
    finite = success & torch.isfinite(gain)
    largest = torch.where(finite, gain, 0.0).amax(-1, keepdim=True)
    largest = torch.where(largest > 0, largest, 1.0)
    return torch.where(finite, gain / largest, success.to(gain.dtype))


def update_memory(
    memory_f: Tensor, memory_cr: Tensor, cell: Tensor, factor: Tensor, rate: Tensor, gain: Tensor, success: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """One cell of each memory (*problems, H) takes the mean of what worked; `cell` (*problems) moves on. [Algorithm 1]

    factor, rate, gain (parent's cost - candidate's), success (*problems, N). A problem without success changes nothing.
    """
    weights = success_weights(gain, success)
    any_success = success.any(-1)
    at = cell[..., None]
    dead = (memory_cr.gather(-1, at)[..., 0] == TERMINAL) | (torch.where(success, rate, 0.0).amax(-1) == 0.0)
    new_cr = torch.where(dead, TERMINAL, lehmer_mean(rate, weights))
    new_f = lehmer_mean(factor, weights)
    memory_f = torch.where(any_success[..., None], memory_f.scatter(-1, at, new_f[..., None]), memory_f)
    memory_cr = torch.where(any_success[..., None], memory_cr.scatter(-1, at, new_cr[..., None]), memory_cr)
    return memory_f, memory_cr, torch.where(any_success, (cell + 1) % memory_f.shape[-1], cell)


def update_archive(
    archive: Tensor, filled: Tensor, parents: Tensor, success: Tensor, u: Tensor
) -> tuple[Tensor, Tensor]:
    """Beaten parents enter the archive one by one: into the next free place, or over a random one when it is full.

    archive (*problems, A, P), of which the first `filled` (*problems) rows are in use; parents (*problems, N, P);
    success, u (*problems, N), uniform draws. Returns the new archive and count.
    """
    capacity = archive.shape[-2]
    entry = torch.arange(parents.shape[-2], device=u.device).expand(success.shape)
    free = filled[..., None] + success.cumsum(-1) - 1
    place = torch.where(free < capacity, free, (u * capacity).long())
    # Where several take the same place, the last one stays: only that one is written, so no write order matters.
    last = entry.new_full((*filled.shape, capacity), -1)
    last = last.scatter_reduce(-1, place.clamp(min=0), torch.where(success, entry, -1), "amax")
    stays = success & (last.gather(-1, place.clamp(min=0)) == entry)
    problem = torch.arange(filled.numel(), device=u.device).reshape(*filled.shape, 1)
    row = (problem * capacity + place)[stays]
    rows = archive.reshape(-1, archive.shape[-1]).index_copy(0, row, parents[stays])
    return rows.reshape(archive.shape), (filled + success.sum(-1)).clamp(max=capacity)
