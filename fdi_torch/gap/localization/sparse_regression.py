"""Sparse Bayesian regression: which few of many columns explain a residual, and the evidence for them.

The coefficients have independent priors c_j ~ N(0, 1/a_j); the precisions a_j maximise the evidence, so that a column
that is not needed gets an infinite precision and no cost (MacKay, 1992; Tipping, 2001, "Sparse Bayesian learning"). For
a residual r, columns C, G = C'C, b = C'r and noise of unit variance,

    log E = b'S b / 2 + log det(S) / 2 + sum log(a) / 2,   S = (G + diag(a))^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

VISIBLE = 1e-6  # chi-square units; columns with less influence are ignored
LOW, HIGH = 1e-8, 1e12  # bounds of the precisions
FIRST_ROUNDS = 12  # iterations with all columns; then vanished columns are removed
VANISHED = 1e-3  # share of a coefficient that the data determine, below which it has vanished
RIDGES = tuple(10.0**k for k in range(-8, 2))  # as shares of the diagonal


@dataclass(frozen=True)
class SparseFit:
    """Solutions of B problems.

    evidence (B,): log evidence against no coefficients. closes (B,): reduction of chi-square. needs (B,): effective
    number of coefficients. mean (B, M): posterior means of the coefficients.
    """

    evidence: Tensor
    closes: Tensor
    needs: Tensor
    mean: Tensor


def sparse_fit(gram: Tensor, score: Tensor, rounds: int) -> SparseFit:
    """Solve B regressions with gram (B, M, M) = C'C and score (B, M) = C'r."""
    size = torch.diagonal(gram, dim1=-2, dim2=-1).clamp(min=0.0)
    visible, size = size > VISIBLE, torch.sqrt(size.clamp(min=1e-12))
    unit, target = gram / size.unsqueeze(-1) / size.unsqueeze(-2), score / size
    first = score.shape[-1] / target.abs().amax(dim=-1, keepdim=True).clamp(min=1e-9) ** 2
    precision, kept = torch.where(visible, first.expand_as(target), HIGH), None
    for turn in range(rounds):
        if turn == FIRST_ROUNDS:
            unit, target, visible, precision, kept = _without_vanished_columns(unit, target, visible, precision)
        mean, determined, _ = _posterior(unit, target, precision)
        updated = determined / (mean * mean).clamp(min=1e-30)
        precision = torch.where(visible, updated.clamp(LOW, HIGH), HIGH)
    mean, determined, half_log_det = _posterior(unit, target, precision)
    evidence = 0.5 * (target * mean).sum(-1) - half_log_det + 0.5 * torch.log(precision).sum(-1) - determined.sum(-1)
    fitted = (mean.unsqueeze(-2) @ unit @ mean.unsqueeze(-1)).flatten()
    whole = mean if kept is None else torch.zeros_like(score).scatter(-1, kept, mean)
    return SparseFit(evidence, 2.0 * (target * mean).sum(-1) - fitted, determined.sum(-1), whole / size)


def _without_vanished_columns(unit: Tensor, target: Tensor, visible: Tensor, precision: Tensor) -> tuple[Tensor, ...]:
    """The same problems without vanished columns, and the indices of those kept.

    All problems keep as many columns as the largest needs.
    """
    _, determined, _ = _posterior(unit, target, precision)
    count = max(int((determined > VANISHED).sum(-1).max()), 1)
    kept = determined.topk(count, dim=-1).indices
    rows, columns = kept.unsqueeze(-1), kept.unsqueeze(-2)
    each = torch.arange(len(kept))[:, None, None]
    return (
        unit[each, rows, columns],
        target.gather(-1, kept),
        visible.gather(-1, kept),
        precision.gather(-1, kept),
        kept,
    )


def _posterior(unit: Tensor, target: Tensor, precision: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Posterior means (B, M), share of each coefficient that the data determine (B, M), and half the log determinant of
    the curvature (B,)."""
    root = _cholesky(unit + torch.diag_embed(precision + 1e-9))
    covariance = torch.cholesky_inverse(root)
    mean = (covariance @ target.unsqueeze(-1)).squeeze(-1)
    determined = (1.0 - precision * torch.diagonal(covariance, dim1=-2, dim2=-1)).clamp(1e-12, 1.0)
    return mean, determined, torch.log(torch.diagonal(root, dim1=-2, dim2=-1)).sum(-1)


def _cholesky(curvature: Tensor) -> Tensor:
    """Cholesky factor (B, M, M) of a curvature.

    Rounding of products of nearly vanishing columns may make a curvature indefinite; a growing ridge is then added.
    """
    root, failed = torch.linalg.cholesky_ex(curvature)
    for ridge in RIDGES if bool(failed.any()) else ():
        wider = ridge * (failed > 0).to(curvature)[:, None] * torch.diagonal(curvature, dim1=-2, dim2=-1).abs()
        curvature = curvature + torch.diag_embed(wider)
        root, failed = torch.linalg.cholesky_ex(curvature)
    return torch.linalg.cholesky(curvature) if bool(failed.any()) else root
