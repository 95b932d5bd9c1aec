"""Sparse Bayesian regression: which few of many columns explain a residual, and the evidence for them.

The coefficients have independent priors c_j ~ N(0, 1/a_j), and a column with infinite precision a_j is not used. For a
residual r, columns C, G = C'C, b = C'r and noise of unit variance,

    log E = b'S b / 2 + log det(S) / 2 + sum log(a) / 2,   S = (G + diag(a))^-1,

over the columns that are used, each of which has a cost (`column_costs`). Their difference is maximised one column at a
time: the column whose addition, removal or re-estimation gains most is changed until nothing gains (Tipping and Faul,
2003, "Fast marginal likelihood maximisation for sparse Bayesian models"). If asked for, a column in use is then
exchanged for another if that gains: of two nearly equal columns, the one that was added first is not always the one
that suits the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

VISIBLE = 1e-6  # chi-square units; columns with less influence are ignored
COLLINEAR = 1e-9  # share of a column that the columns in use leave over; with less, it cannot be added
CONVERGED = 1e-2  # nats
MOST_CHANGES = 500  # a guard against cycles by rounding


@dataclass(frozen=True)
class SparseFit:
    """evidence: log evidence against no coefficients, less the costs. reduction: of half of chi-square by the
    coefficients. mean (M,): posterior means of the coefficients. precision (M,): of their priors, infinite for a column
    that is not used."""

    evidence: float
    reduction: float
    mean: Tensor
    precision: Tensor

    @property
    def used(self) -> Tensor:
        """Whether each column is used, (M,) bool."""
        return torch.isfinite(self.precision)

    def among(self, columns: Tensor) -> SparseFit:
        """The fit of some columns as a fit of all. columns (M,) bool: those that were fitted."""
        mean, precision = torch.zeros(columns.shape).to(self.mean), torch.full(columns.shape, math.inf).to(self.mean)
        mean[columns], precision[columns] = self.mean, self.precision
        return SparseFit(self.evidence, self.reduction, mean, precision)


def column_costs(choices: Tensor, largest: float) -> Tensor:
    """Cost (M,) of using each column, nats.

    choices (M,): number of columns among which each is selected; it costs log(choices). The prior of a coefficient's
    size is log-uniform over log(largest) e-folds, from an influence of one (the norm of its column times its size) to
    `largest`. The evidence as a function of the logarithm of the size has a width of sqrt(pi), so that the
    integral over it is sqrt(pi) / log(largest) of its maximum.
    """
    return torch.log(choices) + math.log(max(math.log(largest) / math.sqrt(math.pi), 1.0))


def sparse_fit(
    gram: Tensor, score: Tensor, costs: Tensor, start: Tensor | None = None, *, exchanges: bool = False
) -> SparseFit:
    """Solve the regression with gram (M, M) = C'C and score (M,) = C'r.

    costs (M,): of using each column. start: precisions of the first columns from which the ascent starts. exchanges:
    whether columns are exchanged, which takes long if many are in use.
    """
    size = torch.diagonal(gram).clamp(min=0.0)
    visible, size = size > VISIBLE, torch.sqrt(size.clamp(min=VISIBLE))
    unit, target = gram / size.unsqueeze(1) / size, score / size
    precision = torch.full_like(target, math.inf)
    if start is not None:
        known = slice(len(start))
        precision[known] = torch.where(visible[known], start / size[known].square(), math.inf)
    costs = torch.where(visible, costs, math.inf)
    precision = _ascended(unit, target, precision, costs)
    while exchanges and (better := _exchanged(unit, target, precision, costs)) is not None:
        precision = better
    posterior = _Posterior.of(unit, target, precision)
    evidence, reduction = posterior.evidence(target, precision, costs), posterior.reduction(target)
    return SparseFit(evidence, reduction, posterior.mean / size, precision * size.square())


def _ascended(unit: Tensor, target: Tensor, precision: Tensor, costs: Tensor) -> Tensor:
    """The precisions after all single changes that gain."""
    precision = precision.clone()
    for _ in range(MOST_CHANGES if len(target) else 0):
        gain, updated = _changes(unit, target, precision, costs)
        best = int(gain.argmax())
        if not float(gain[best]) > CONVERGED:
            break
        precision[best] = updated[best]
    return precision


def _exchanged(unit: Tensor, target: Tensor, precision: Tensor, costs: Tensor) -> Tensor | None:
    """The precisions after the first exchange of a column in use that gains, and what follows; None if none does."""
    least = _Posterior.of(unit, target, precision).evidence(target, precision, costs) + CONVERGED
    used = torch.isfinite(precision)
    for j in used.nonzero().flatten().tolist():
        trial = precision.clone()
        trial[j] = math.inf
        gain, updated = _changes(unit, target, trial, costs)
        best = int(torch.where(used, -math.inf, gain).argmax())
        trial[best] = updated[best]
        trial = _ascended(unit, target, trial, costs)
        if _Posterior.of(unit, target, trial).evidence(target, trial, costs) > least:
            return trial
    return None


def _changes(unit: Tensor, target: Tensor, precision: Tensor, costs: Tensor) -> tuple[Tensor, Tensor]:
    """Gain in log evidence, costs included, of the best change of each precision (M,), and the precision after it.

    Equations 16 to 33 of the paper; `sparsity` is S, `quality` is Q.
    """
    posterior, used = _Posterior.of(unit, target, precision), torch.isfinite(precision)
    sparsity, quality = posterior.sparsity, target - unit @ posterior.mean
    now = torch.where(used, precision, 1.0)
    # s and q: what S and Q would be without the column itself.
    factor = torch.where(used, now / (now - sparsity), 1.0)
    s, q = factor * sparsity, factor * quality
    excess = q * q - s
    likeliest = torch.where(excess > 0.0, s * s / excess.clamp(min=1e-300), math.inf)
    ratio = (quality * quality / sparsity.clamp(min=1e-300)).clamp(min=1e-300)
    added = 0.5 * (ratio - 1.0 - torch.log(ratio)) - costs
    change = torch.where(excess > 0.0, 1.0 / likeliest, 0.0) - 1.0 / now
    left = (1.0 + sparsity * change).clamp(min=1e-300)
    estimated = 0.5 * (quality * quality * change / left - torch.log(left))
    share = (1.0 - sparsity / now).clamp(min=1e-300)
    removed = 0.5 * (quality * quality / (sparsity - now) - torch.log(share)) + costs
    may_be_added = ~used & (excess > 0.0) & (sparsity > COLLINEAR)
    keep = used & (excess > 0.0) & (estimated >= removed)
    gain = torch.where(used, torch.where(keep, estimated, removed), torch.where(may_be_added, added, -math.inf))
    return gain.nan_to_num(nan=-math.inf), torch.where(keep | may_be_added, likeliest, math.inf)


@dataclass(frozen=True)
class _Posterior:
    """mean (M,): zero for columns that are not used. sparsity (M,): C_j' (I - C S C') C_j of each column. half_log_det:
    half the log determinant of the curvature of the columns in use."""

    mean: Tensor
    sparsity: Tensor
    half_log_det: float

    def reduction(self, target: Tensor) -> float:
        """Reduction of half of chi-square, b'S b / 2."""
        return 0.5 * float(target @ self.mean)

    def evidence(self, target: Tensor, precision: Tensor, costs: Tensor) -> float:
        """Log evidence less the costs."""
        used = torch.isfinite(precision)
        volume = 0.5 * float(torch.log(precision[used]).sum()) - self.half_log_det
        return self.reduction(target) + volume - float(costs[used].sum())

    @staticmethod
    def of(unit: Tensor, target: Tensor, precision: Tensor) -> _Posterior:
        used = torch.isfinite(precision).nonzero().flatten()
        root = torch.linalg.cholesky(unit[used][:, used] + torch.diag(precision[used]))
        mean = torch.zeros_like(target)
        mean[used] = torch.cholesky_solve(target[used].unsqueeze(1), root).squeeze(1)
        explained = torch.linalg.solve_triangular(root, unit[used], upper=False)
        sparsity = (torch.diagonal(unit) - explained.square().sum(dim=0)).clamp(min=0.0)
        return _Posterior(mean, sparsity, float(torch.log(torch.diagonal(root)).sum()))
