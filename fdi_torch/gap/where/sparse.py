"""Of how few of many forms a discrepancy can be put together, and what that says for it.

Coefficients c ~ N(0, 1/a_j) with a variance each, found by their evidence (MacKay, 1992; Tipping, 2001, "Sparse
Bayesian learning"): what is not needed goes to nothing and costs nothing. For a residual r with columns C, C'C = G,
C'r = b and noise of unit variance,

    log E = b'S b / 2 + log det(S) / 2 + sum log(a) / 2,   S = (G + diag(a))^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

SEEN = 1e-6  # chi-square units below which a column does nothing
LOW, HIGH = 1e-8, 1e12
FIRST_ROUNDS = 12  # after which columns that are needed for less than so much are left out
VANISHED = 1e-3
RIDGES = tuple(10.0**k for k in range(-8, 2))  # shares of the diagonal


@dataclass(frozen=True)
class Sparse:
    """Of B problems: log evidence (B,) against no coefficients at all, closes (B,), chi-square units, how many
    coefficients they need (B,), and their posterior means (B, M)."""

    evidence: Tensor
    closes: Tensor
    needs: Tensor
    mean: Tensor


def sparse(gram: Tensor, score: Tensor, rounds: int) -> Sparse:
    """gram (B, M, M), score (B, M)."""
    size = torch.diagonal(gram, dim1=-2, dim2=-1).clamp(min=0.0)
    live, size = size > SEEN, torch.sqrt(size.clamp(min=1e-12))
    unit, aim = gram / size.unsqueeze(-1) / size.unsqueeze(-2), score / size
    first = score.shape[-1] / aim.abs().amax(dim=-1, keepdim=True).clamp(min=1e-9) ** 2
    precision, kept = torch.where(live, first.expand_as(aim), HIGH), None
    for turn in range(rounds):
        if turn == FIRST_ROUNDS:
            unit, aim, live, precision, kept = _needed(unit, aim, live, precision)
        mean, used, _ = _posterior(unit, aim, precision)
        found = used / (mean * mean).clamp(min=1e-30)
        precision = torch.where(live, found.clamp(LOW, HIGH), HIGH)
    mean, used, half_log_det = _posterior(unit, aim, precision)
    evidence = 0.5 * (aim * mean).sum(-1) - half_log_det + 0.5 * torch.log(precision).sum(-1) - used.sum(-1)
    fitted = (mean.unsqueeze(-2) @ unit @ mean.unsqueeze(-1)).flatten()
    whole = mean if kept is None else torch.zeros_like(score).scatter(-1, kept, mean)
    return Sparse(evidence, 2.0 * (aim * mean).sum(-1) - fitted, used.sum(-1), whole / size)


def _needed(unit: Tensor, aim: Tensor, live: Tensor, precision: Tensor) -> tuple[Tensor, ...]:
    """The same problems without the columns that all but vanished, as many in each as the largest needs, and which."""
    _, used, _ = _posterior(unit, aim, precision)
    count = max(int((used > VANISHED).sum(-1).max()), 1)
    kept = used.topk(count, dim=-1).indices
    rows, columns = kept.unsqueeze(-1), kept.unsqueeze(-2)
    each = torch.arange(len(kept))[:, None, None]
    return unit[each, rows, columns], aim.gather(-1, kept), live.gather(-1, kept), precision.gather(-1, kept), kept


def _posterior(unit: Tensor, aim: Tensor, precision: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean (B, M), the share of each coefficient that the data determine (B, M), and half the log determinant of the
    curvature (B,)."""
    root = _root(unit + torch.diag_embed(precision + 1e-9))
    covariance = torch.cholesky_inverse(root)
    mean = (covariance @ aim.unsqueeze(-1)).squeeze(-1)
    used = (1.0 - precision * torch.diagonal(covariance, dim1=-2, dim2=-1)).clamp(1e-12, 1.0)
    return mean, used, torch.log(torch.diagonal(root, dim1=-2, dim2=-1)).sum(-1)


def _root(curvature: Tensor) -> Tensor:
    """Cholesky's, (B, M, M). Products of columns that are nearly nothing are mostly rounding, and may leave a curvature
    that no columns could have: such a one is widened until it has a root.
    """
    root, failed = torch.linalg.cholesky_ex(curvature)
    for ridge in RIDGES if bool(failed.any()) else ():
        wider = ridge * (failed > 0).to(curvature)[:, None] * torch.diagonal(curvature, dim1=-2, dim2=-1).abs()
        curvature = curvature + torch.diag_embed(wider)
        root, failed = torch.linalg.cholesky_ex(curvature)
    return torch.linalg.cholesky(curvature) if bool(failed.any()) else root
