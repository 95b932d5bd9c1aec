"""Sparse Bayesian regression: which few of many regressors explain a residual, and the evidence for them.

A regressor has one column or several. Its coefficients have independent priors c_j ~ N(0, 1/a_j) with the same
precision, and a regressor with infinite precision is not used. For a residual r, columns C, G = C'C, b = C'r and noise
of unit variance,

    log E = b'S b / 2 + log det(S) / 2 + sum log(a) / 2,   S = (G + diag(a))^-1,

over the columns that are used. Each regressor in use has a cost (`regressor_costs`). The difference is maximised one
regressor at a time: the one whose addition, removal or re-estimation gains most is changed until nothing gains
(Tipping and Faul, 2003, "Fast marginal likelihood maximisation for sparse Bayesian models"). If asked for, a regressor
in use is then exchanged for another if that gains: of two nearly equal columns, the one that was added first is not
always the one that suits the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

VISIBLE = 1e-6  # chi-square units; columns with less influence are ignored
COLLINEAR = 1e-9  # share of a column that the columns in use leave over; with less, it cannot be added
# Least precision of the coefficient of a column of unit norm, above the rounding errors of the Gram matrix: without it,
# columns that depend on each other have no Cholesky factor.
LEAST_PRECISION = 1e-12
CONVERGED = 1e-2  # nats
MOST_CHANGES = 500  # a guard against cycles by rounding
WIDEST = 30.0  # e-folds below the largest strength, within which the precision of several columns is searched


@dataclass(frozen=True)
class SparseFit:
    """evidence: log evidence against no coefficients, less the costs. reduction: of half of chi-square by the
    coefficients. parameters: effective number of these (MacKay, 1992). mean (M,): their posterior means. precision
    (M,): of their priors, infinite for a column that is not used."""

    evidence: float
    reduction: float
    parameters: float
    mean: Tensor
    precision: Tensor

    @property
    def used(self) -> Tensor:
        """Whether each column is used, (M,) bool."""
        return torch.isfinite(self.precision)

    def among(self, columns: Tensor) -> SparseFit:
        """This fit of some columns, extended to all M columns. columns (M,) bool: those that were fitted."""
        mean, precision = torch.zeros(columns.shape).to(self.mean), torch.full(columns.shape, math.inf).to(self.mean)
        mean[columns], precision[columns] = self.mean, self.precision
        return replace(self, mean=mean, precision=precision)


def regressor_costs(choices: Tensor, largest: float) -> Tensor:
    """Cost (M,) of using each regressor, nats.

    choices (M,): number of regressors among which each is selected; it costs log(choices). The prior of a coefficient's
    size is log-uniform over log(largest) e-folds, from an influence of one (the norm of its column times its size) to
    `largest`. The evidence as a function of the logarithm of the size has a width of sqrt(pi), so that the
    integral over it is sqrt(pi) / log(largest) of its maximum.
    """
    return torch.log(choices) + math.log(max(math.log(largest) / math.sqrt(math.pi), 1.0))


def sparse_fit(
    gram: Tensor,
    score: Tensor,
    regressor: Tensor,
    costs: Tensor,
    start: Tensor | None = None,
    *,
    exchanges: bool = False,
) -> SparseFit:
    """Solve the regression with gram (M, M) = C'C and score (M,) = C'r.

    regressor (M,): the one that each column belongs to. costs (M,): of using it. start: precisions of the first columns
    from which the ascent starts. exchanges: whether regressors are exchanged, which takes long if many are in use.
    """
    problem = _Problem(gram, score, regressor, costs)
    precision = problem.ascended(problem.initial(start))
    while exchanges and (better := problem.exchanged(precision)) is not None:
        precision = better
    posterior = problem.posterior(precision)
    return SparseFit(
        problem.evidence(posterior, precision),
        problem.reduction(posterior),
        posterior.parameters(precision),
        posterior.mean / problem.size,
        precision * problem.size.square(),
    )


class _Problem:
    """A regression on columns scaled to unit norm. size (M,): their norms."""

    def __init__(self, gram: Tensor, score: Tensor, regressor: Tensor, costs: Tensor) -> None:
        squared = torch.diagonal(gram).clamp(min=0.0)
        _, regressor, columns = torch.unique(regressor, return_inverse=True, return_counts=True)
        self.size = torch.sqrt(squared.clamp(min=VISIBLE))
        self.unit, self.target = gram / self.size.unsqueeze(1) / self.size, score / self.size
        self.regressor, of_one = regressor, columns[regressor]
        self.single = of_one == 1
        self.visible = (squared > VISIBLE) | ~self.single
        self.costs = torch.where(self.visible, costs, math.inf)
        self.share = self.costs / of_one  # of the cost of its regressor, for each column
        self.several = [(regressor == r).nonzero().flatten() for r in (columns > 1).nonzero().flatten().tolist()]

    def initial(self, start: Tensor | None) -> Tensor:
        """The precisions (M,) from which the ascent starts."""
        precision = torch.full_like(self.target, math.inf)
        if start is not None:
            known = slice(len(start))
            scaled = (start / self.size[known].square()).clamp(min=LEAST_PRECISION)
            precision[known] = torch.where(self.visible[known], scaled, math.inf)
        return precision

    def posterior(self, precision: Tensor) -> _Posterior:
        return _Posterior.of(self.unit, self.target, precision)

    def reduction(self, posterior: _Posterior) -> float:
        """Reduction of half of chi-square, b'S b / 2."""
        return 0.5 * float(self.target @ posterior.mean)

    def evidence(self, posterior: _Posterior, precision: Tensor) -> float:
        """Log evidence less the costs."""
        used = torch.isfinite(precision)
        volume = 0.5 * float(torch.log(precision[used]).sum()) - posterior.half_log_det
        return self.reduction(posterior) + volume - float(self.share[used].sum())

    def ascended(self, precision: Tensor) -> Tensor:
        """The precisions after all changes of one regressor that gain."""
        precision = precision.clone()
        for n in range(MOST_CHANGES if len(self.target) else 0):
            change = self._best_of_single(precision)
            if n == 0 or not change.gain > CONVERGED:
                change = max([change, *(self._of_several(precision, columns) for columns in self.several)])
            if not change.gain > CONVERGED:
                break
            precision[change.columns] = change.precision
        return precision

    def exchanged(self, precision: Tensor) -> Tensor | None:
        """The precisions after the first exchange of a regressor in use that gains, and what follows; None if none
        does."""
        least, used = self.evidence(self.posterior(precision), precision) + CONVERGED, torch.isfinite(precision)
        for r in torch.unique(self.regressor[used]).tolist():
            trial = torch.where(self.regressor == r, math.inf, precision)
            change = self._best_of_single(trial, ~used)
            trial[change.columns] = change.precision
            trial = self.ascended(trial)
            if self.evidence(self.posterior(trial), trial) > least:
                return trial
        return None

    def _best_of_single(self, precision: Tensor, among: Tensor | None = None) -> _Change:
        """The best change of the precision of one column, its regressor. among (M,) bool: the columns considered.

        Equations 16 to 33 of the paper; `sparsity` is S, `quality` is Q. For a column in use, they follow from the mean
        and the variance of its coefficient without the difference of two nearly equal numbers.
        """
        posterior, used = self.posterior(precision), torch.isfinite(precision)
        mean, now, variance = posterior.mean, torch.where(used, precision, 1.0), posterior.variance
        sparsity = torch.where(used, now * (1.0 - now * variance), posterior.sparsity)
        quality = torch.where(used, now * mean, self.target - self.unit @ mean)
        # s and q: what S and Q would be without the column itself.
        s = torch.where(used, 1.0 / variance - now, sparsity)
        q = torch.where(used, mean / variance, quality)
        excess = q * q - s
        likeliest = torch.where(excess > 0.0, (s * s / excess.clamp(min=1e-300)).clamp(min=LEAST_PRECISION), math.inf)
        ratio = (quality * quality / sparsity.clamp(min=1e-300)).clamp(min=1e-300)
        added = 0.5 * (ratio - 1.0 - torch.log(ratio)) - self.costs
        change = torch.where(excess > 0.0, 1.0 / likeliest, 0.0) - 1.0 / now
        left = (1.0 + sparsity * change).clamp(min=1e-300)
        estimated = 0.5 * (quality * quality * change / left - torch.log(left))
        removed = self.costs - 0.5 * (mean * mean / variance + torch.log(now * variance))
        may_be_added = ~used & (excess > 0.0) & (sparsity > COLLINEAR)
        keep = used & (excess > 0.0) & (estimated >= removed)
        gain = torch.where(used, torch.where(keep, estimated, removed), torch.where(may_be_added, added, -math.inf))
        considered = self.single if among is None else self.single & among
        gain = torch.where(considered, gain.nan_to_num(nan=-math.inf), -math.inf)
        best = int(gain.argmax())
        likeliest = torch.where(keep | may_be_added, likeliest, math.inf)
        return _Change(float(gain[best]), torch.tensor([best]), likeliest[best : best + 1])

    def _of_several(self, precision: Tensor, columns: Tensor) -> _Change:
        """The best change of the common precision a of the coefficients of several columns.

        Without them, the readings have the covariance K. With C'K^-1 C = U diag(s) U' and q = U'C'K^-1 r, the columns
        add sum(q^2 / (a + s) - log(1 + s / a)) / 2 to the evidence.
        """
        without, size = precision.clone(), self.size[columns]
        without[columns] = math.inf
        posterior = self.posterior(without)
        explained = posterior.explained[:, columns]
        strength = (self.unit[columns][:, columns] - explained.T @ explained) * size * size.unsqueeze(1)
        quality = (self.target[columns] - self.unit[columns] @ posterior.mean) * size
        s, rotation = torch.linalg.eigh(strength)
        s, q = s.clamp(min=0.0), rotation.T @ quality

        def gained(log_precision: Tensor) -> Tensor:
            a = torch.exp(log_precision).unsqueeze(1)
            return 0.5 * (q * q / (a + s) - torch.log1p(s / a)).sum(dim=1) - self.costs[columns[0]]

        least = torch.log(LEAST_PRECISION * size.square().max())
        center, width = torch.log(s[-1].clamp(min=VISIBLE)) - 0.5 * WIDEST, 0.5 * WIDEST
        for count in (61, 51):
            tried = (center + width * torch.linspace(-1.0, 1.0, count, dtype=s.dtype)).clamp(min=least)
            gains = gained(tried)
            center, width = tried[gains.argmax()], 2.0 * width / (count - 1)
        now = self.size[columns[0]].square() * precision[columns[0]]
        before = float(gained(torch.log(now).unsqueeze(0))) if math.isfinite(now) else 0.0
        best = float(gains.max())
        chosen = torch.exp(center) / size.square() if best > 0.0 else torch.full_like(size, math.inf)
        return _Change(max(best, 0.0) - before, columns, chosen)


@dataclass(frozen=True)
class _Change:
    """gain: in log evidence, costs included. precision (N,): of the columns (N,), after the change."""

    gain: float
    columns: Tensor
    precision: Tensor

    def __lt__(self, other: _Change) -> bool:
        return self.gain < other.gain


@dataclass(frozen=True)
class _Posterior:
    """mean, variance (M,): of the coefficients, 0 and 1 for columns that are not used. root (U, U): L of the curvature
    L L' of the U columns in use. explained (U, M): L^-1 C_u'C_j of each column. sparsity (M,): C_j' (I - C S C') C_j.
    """

    mean: Tensor
    variance: Tensor
    root: Tensor
    explained: Tensor
    sparsity: Tensor

    @property
    def half_log_det(self) -> float:
        return float(torch.log(torch.diagonal(self.root)).sum())

    def parameters(self, precision: Tensor) -> float:
        """Effective number of coefficients, the sum of 1 - a S_jj (MacKay, 1992)."""
        used = torch.isfinite(precision)
        return len(self.root) - float(precision[used] @ self.variance[used])

    @staticmethod
    def of(unit: Tensor, target: Tensor, precision: Tensor) -> _Posterior:
        used = torch.isfinite(precision).nonzero().flatten()
        root = torch.linalg.cholesky(unit[used][:, used] + torch.diag(precision[used]))
        mean, variance = torch.zeros_like(target), torch.ones_like(target)
        mean[used] = torch.cholesky_solve(target[used].unsqueeze(1), root).squeeze(1)
        inverse = torch.linalg.solve_triangular(root, torch.eye(len(root)).to(root), upper=False)
        variance[used] = inverse.square().sum(dim=0)
        explained = torch.linalg.solve_triangular(root, unit[used], upper=False)
        sparsity = (torch.diagonal(unit) - explained.square().sum(dim=0)).clamp(min=0.0)
        return _Posterior(mean, variance, root, explained, sparsity)
