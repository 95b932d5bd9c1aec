"""One more regressor of a component, with its kink or its step in time where it explains most.

The grids of `regressors.py` are coarse. Where a discrepancy is many times the noise, a law with a kink between two
nodes, or a change between two steps in time, would need many regressors of the grid. As in orthogonal matching pursuit
(Pati, Rezaiifar and Krishnaprasad, 1993), the next regressor is the one with the largest gain in addition to all that
were selected before: among kinks on a fine grid and steps in time at every step. One adjoint pass compares all of them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.localization.discrepancy_regression import Discrepancy, DiscrepancyRegression, Regressors
from fdi_torch.gap.localization.single_regressor_gain import (
    adjoints_of,
    gains_of,
    inflow_weights,
    largest_influence,
    parameter_basis,
    random_signs,
    whitened_residual,
)
from fdi_torch.gap.localization.sparse_regression import column_costs
from fdi_torch.simulate.joint_collocation import with_blanks


def with_best_position(
    regression: DiscrepancyRegression,
    place: str,
    under: Fitter,
    fit: Fit,
    discrepancy: Discrepancy,
    used: Tensor,
    generator: torch.Generator,
) -> Discrepancy | None:
    """The discrepancy with one more regressor, or None if none is worth its selection.

    under: fitter with the disturbance noise. used (M,): whether a regressor of the discrepancy was selected.
    """
    basis = parameter_basis(under, fit, discrepancy.columns[..., used])
    residual = whitened_residual(under, fit, discrepancy.linearised)
    adjoints = adjoints_of(regression, under, torch.cat([residual, random_signs(residual, generator)], dim=1), basis)
    channel, regressors = regression.sensor(place), regression.at(place)[0]
    if channel is None:
        weights = inflow_weights(regression, place, adjoints)
    else:
        weights = [adjoints.readings[piece.rows, channel].T for piece in regression.pieces]
    pairs = list(zip(regressors, weights, strict=True))
    products = [torch.stack([r.fine @ w.T for r, w in pairs]).sum(dim=0), *(_of_steps(r, w) for r, w in pairs)]
    gains = [gains_of(p) for p in products]
    choices = sum(len(g) for g in gains)
    family = max(range(len(gains)), key=lambda k: float(gains[k].max()))
    position = int(gains[family].argmax())
    (cost,) = column_costs(torch.tensor([float(choices)]), largest_influence(under)).tolist()
    if float(gains[family][position]) < cost:
        return None
    columns = []
    for k, r in enumerate(regressors):
        step = torch.zeros_like(r.factor)
        if family == k + 1:
            step[position:] = r.factor[position:]
        function = step if family else r.fine[position]
        columns.append(regression.influence(place, k, function.unsqueeze(0))[..., 0])
    return discrepancy.with_column(with_blanks(columns, dim=0), choices)


def _of_steps(regressors: Regressors, weights: Tensor) -> Tensor:
    """Products (K, .) of the steps in time at every step with weights (., K)."""
    return (regressors.factor * weights).flip(-1).cumsum(dim=-1).flip(-1).T
