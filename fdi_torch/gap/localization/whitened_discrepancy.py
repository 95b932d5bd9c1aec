"""Sparse regression of the whitened residual on the influence of a discrepancy."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.linear_parameters import decomposed, without
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_columns import Columns, Discrepancy
from fdi_torch.gap.localization.discrepancy_regression import BATCH
from fdi_torch.gap.localization.sparse_regression import SparseFit, sparse_fit

MOST_ROWS = 1000  # rows per channel from which columns are selected; more samples are summed in groups


@dataclass(frozen=True)
class _Projection:
    """Rows from which the parameters of a fit are projected out: sums of groups of samples, and the parameters' priors.

    group: samples in a sum. basis (R, P): of the parameters' influence. residual (R, 1): what it leaves.
    """

    group: int
    basis: Tensor
    residual: Tensor

    @staticmethod
    def of(group: int, residual: Tensor, jacobian: Tensor, pull: Tensor, off: Tensor) -> _Projection:
        """residual (S, C) and jacobian (S, C, P): whitened. pull, off (P,): of the priors, as in `decomposed`."""
        basis, _ = decomposed(_grouped(jacobian, group), pull)
        rows = torch.cat([_grouped(residual.unsqueeze(-1), group), -off.unsqueeze(1)])
        return _Projection(group, basis, without(basis, rows))

    def remaining(self, columns: Tensor) -> Tensor:
        """The part (R, M) of whitened columns (S, C, M) that the projection leaves."""
        return without(self.basis, _grouped(columns, self.group))


@dataclass(frozen=True, eq=False)
class _Block:
    """Columns (S, C, M), and what the projection for the selection leaves of them once they are whitened (R, M)."""

    columns: Tensor
    remaining: Tensor


class WhitenedDiscrepancy:
    """The columns of a discrepancy and the residual, whitened by one noise model, with the parameters of a fit
    projected out.

    To save time, columns are selected with successive samples summed in groups, each shorter than the changes of any
    regressor. The sums lack little of the residual, but this may be many nats of a large one: they serve to select
    columns, not to weigh them.
    """

    def __init__(self, under: Fitter, fit: Fit, discrepancy: Discrepancy) -> None:
        residual, jacobian = under.white(discrepancy.linearised)
        scale, pull, off = under.priors(fit.space, fit.theta)
        groups = max(len(residual[0]) // MOST_ROWS, 1), 1
        self._selecting, self._exact = (
            _Projection.of(group, residual[0], jacobian[0] * scale, pull, off) for group in groups
        )
        self._under, self._products = under, dict[tuple[_Block, _Block], Tensor]()
        self._blocks = list(map(self._block, discrepancy.columns.blocks))

    def _block(self, columns: Tensor) -> _Block:
        parts = columns.split(BATCH, dim=-1)
        remaining = [self._selecting.remaining(self._under.whiten(part)) for part in parts]
        return _Block(columns, torch.cat(remaining, dim=1))

    def with_columns(self, columns: Columns) -> WhitenedDiscrepancy:
        """The regression with other columns (S, C, M), of which only new blocks are whitened."""
        other, known = copy(self), {id(b.columns): b for b in self._blocks}
        other._blocks = [known.get(id(columns)) or self._block(columns) for columns in columns.blocks]
        return other

    def _product(self, a: _Block, b: _Block) -> Tensor:
        if (a, b) not in self._products:
            self._products[a, b] = a.remaining.T @ b.remaining
            self._products[b, a] = self._products[a, b].T
        return self._products[a, b]

    def sparse_fit(
        self, regressor: Tensor, costs: Tensor, start: Tensor | None = None, *, exchanges: bool = False
    ) -> SparseFit:
        """Sparse regression on the columns. regressor (M,): that of each. costs (M,): of using it. start: precisions of
        the first columns."""
        gram = torch.cat([torch.cat([self._product(a, b) for b in self._blocks], dim=1) for a in self._blocks])
        score = torch.cat([(b.remaining.T @ self._selecting.residual).squeeze(1) for b in self._blocks])
        selected = sparse_fit(gram, score, regressor, costs, start, exchanges=exchanges)
        used = selected.used
        in_use = Columns(tuple(b.columns for b in self._blocks))[used]
        columns = self._exact.remaining(self._under.whiten(in_use))
        score = (columns.T @ self._exact.residual).squeeze(1)
        precision = selected.precision[used]
        return sparse_fit(columns.T @ columns, score, regressor[used], costs[used], precision).among(used)


def _grouped(x: Tensor, each: int) -> Tensor:
    """Sums (S / each C, M) of groups of samples of x (S, C, M), scaled to unit variance."""
    groups = x[: len(x) // each * each].unflatten(0, (-1, each))
    # PyTorch sums a short dimension slowly.
    sums = x if each == 1 else sum(groups.unbind(1)[1:], groups[:, 0]) / each**0.5
    return sums.flatten(0, 1)
