"""Isolation of fault modes in a study: stated against true sets of faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.study.monte_carlo import Trial
from fdi_torch.study.summary import column


@dataclass(frozen=True)
class Isolation:
    """Counts of stated modes.

    labels (M,): 'none', 'theta_1', 'theta_1 + theta_3' ... confusion (M, M): trials by true mode (row) and stated mode
    (column). missed, false: parameters wrongly stated as fault-free, or as faulty. right: correctly stated modes.
    """

    labels: tuple[str, ...]
    confusion: tuple[tuple[int, ...], ...]
    trials: int
    right: int
    missed: int
    false: int


def count_modes(space: ParameterSpace, trials: Sequence[Trial], confidence: float = 0.95) -> Isolation:
    """State a parameter as faulty if it differs from nominal significantly, and count the modes.

    The confidence is divided among the parameters (Bonferroni).
    """
    truth, value, std = (column(trials, name) for name in ("truth", "free", "free_std"))
    reach = NormalDist().inv_cdf(1.0 - (1.0 - confidence) / (2 * len(space)))
    faulty = truth != space.nominal()
    stated = (value - space.nominal()).abs() > reach * std
    places = {code: k for k, code in enumerate(sorted({*_codes(faulty), *_codes(stated)}, key=_by_size))}
    confusion = [[0] * len(places) for _ in places]
    for row, col in zip(_codes(faulty), _codes(stated), strict=True):
        confusion[places[row]][places[col]] += 1
    return Isolation(
        labels=tuple(_label(space, code) for code in places),
        confusion=tuple(tuple(row) for row in confusion),
        trials=len(trials),
        right=int((faulty == stated).all(-1).sum()),
        missed=int((faulty & ~stated).sum()),
        false=int((stated & ~faulty).sum()),
    )


def _codes(faulty: Tensor) -> list[int]:
    """(trials, P) bool as one integer per trial, one bit per parameter."""
    return (faulty.to(torch.int64) << torch.arange(faulty.shape[-1])).sum(-1).tolist()


def _by_size(code: int) -> tuple[int, int]:
    return code.bit_count(), code


def _label(space: ParameterSpace, code: int) -> str:
    return " + ".join(n.removesuffix(".size") for i, n in enumerate(space.names) if code >> i & 1) or "none"
