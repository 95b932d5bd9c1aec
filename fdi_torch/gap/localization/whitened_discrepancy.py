"""Sparse regression of the whitened residual on the influence of a discrepancy."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.linear_parameters import decomposed, without
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_regression import Columns, Discrepancy
from fdi_torch.gap.localization.sparse_regression import SparseFit, sparse_fit

MOST_ROWS = 1000  # rows per channel from which columns are selected; more samples are summed in groups


@dataclass(frozen=True)
class NormalEquations:
    """gram (M, M) = C'C and score (M,) = C'r of columns C and the residual r."""

    gram: Tensor
    score: Tensor


class WhitenedDiscrepancy:
    """The columns of a discrepancy and the residual under one noise, with the parameters of a fit projected out.

    columns (S C, M) and residual (S C,): whitened by the fitter `under`, not projected.
    """

    def __init__(self, under: Fitter, fit: Fit, discrepancy: Discrepancy) -> None:
        residual, jacobian = under.white(discrepancy.linearised)
        scale, self._pull, self._off = under.priors(fit.space, fit.theta)
        self._under, self._residual, self._jacobian = under, residual[0], jacobian[0] * scale
        self._white = {id(block): (block, under.whiten(block)) for block in discrepancy.columns.blocks}

    def with_columns(self, columns: Columns) -> WhitenedDiscrepancy:
        """The same with other columns (S, C, M), of which only new blocks are whitened."""
        other = copy(self)
        other._white = {id(b): self._white.get(id(b)) or (b, self._under.whiten(b)) for b in columns.blocks}
        return other

    @property
    def _columns(self) -> Columns:
        return Columns(tuple(white for _, white in self._white.values()))

    def normal_equations(self, used: Tensor | None = None) -> NormalEquations:
        """Of some columns, used (M,) bool, with all samples; or of all, with samples summed in groups.

        A group is shorter than any regressor's changes. What a sum of its samples leaves out is little of the residual,
        but may be many nats if the residual is large: it serves to select columns, not to weigh them.
        """
        blocks = self._columns.blocks if used is None else [self._columns[used]]
        group = max(len(self._residual) // MOST_ROWS, 1) if used is None else 1
        r, j, *grouped = (
            _grouped(x, group).flatten(0, 1) for x in (self._residual[..., None], self._jacobian, *blocks)
        )
        c = torch.cat(grouped, dim=-1)
        basis, _ = decomposed(j, self._pull)
        of_priors = torch.nn.functional.pad(-self._off.unsqueeze(1), (c.shape[1], 0))
        remaining = without(basis, torch.cat([torch.cat([c, r], dim=1), of_priors]))
        products = remaining.T @ remaining
        return NormalEquations(products[:-1, :-1], products[:-1, -1])

    def sparse_fit(self, costs: Tensor) -> SparseFit:
        """Sparse regression on the columns. costs (M,): of using each."""
        selecting = self.normal_equations()
        used = sparse_fit(selecting.gram, selecting.score, costs).used
        exact = self.normal_equations(used)
        return sparse_fit(exact.gram, exact.score, costs[used]).among(used)


def _grouped(x: Tensor, each: int) -> Tensor:
    """Sums (S / each, ...) of groups of samples of x (S, ...), scaled to unit variance."""
    groups = len(x) // each
    return x[: groups * each].reshape(groups, each, *x.shape[1:]).sum(dim=1) / each**0.5
