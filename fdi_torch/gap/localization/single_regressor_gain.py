"""First-order gain of the best single regressor of each place, by one adjoint pass.

With the columns C of all regressors, the parameters of a fit projected out, the residual r and random signs z,

    score = C'r,    diag(C'C) = E[(C'z)^2]       (Hutchinson, 1990)

need only r and z mapped back through the noise whitening, the sensors and the linearised plant to the flow into each
tank at each time. A whole network costs hardly more than one component. The result tells for which places the full
regression (`discrepancy_regression.py`) is worth its cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.localization.component_regressors import discrepancy_model_at
from fdi_torch.gap.localization.discrepancy_regression import Discrepancy, DiscrepancyRegression
from fdi_torch.plant.description import OUTSIDE
from fdi_torch.simulate.collocation import Linearised

SIGNS = 64  # random sign vectors; the diagonal of C'C is then accurate to about 20 %


@dataclass(frozen=True)
class _Adjoints:
    """Residual and random signs (1 + SIGNS columns) mapped back to the readings (S, C, .), and per recording to the
    flows into each tank and the rates of its level, (tanks, ., K)."""

    readings: Tensor
    inflows: list[Tensor]
    rates: list[Tensor]


def single_regressor_gains(
    regression: DiscrepancyRegression, under: Fitter, fit: Fit, places: Sequence[str], generator: torch.Generator
) -> dict[str, float]:
    """Gain in log evidence of the best single regressor of each place. under: fitter with the disturbance noise."""
    sensors = [s.name for s in regression.fitter.data.plant.sensors]
    basis, rows = _parameter_basis(under, fit)
    signs = torch.randint(0, 2, (rows, SIGNS), generator=generator, dtype=torch.float64) * 2.0 - 1.0
    adjoints = _adjoints(
        regression, under, torch.cat([_residual(under, fit, regression.linearised), signs], dim=1), basis
    )
    gains = {}
    for place in places:
        if place in sensors:
            products = _sensor_products(regression.of(place), under, fit, basis, adjoints, sensors.index(place))
        else:
            products = _flow_products(regression, place, adjoints)
        gains[place] = _best_gain(products)
    return gains


def _best_gain(products: Tensor) -> float:
    """products (M, 1 + SIGNS): of the columns with the residual and with the random signs."""
    gain = 0.5 * products[:, 0].square() / products[:, 1:].square().mean(dim=1).clamp(min=1e-12)
    # A regressor that reduces chi-square by G costs (1 + log G) / 2 nats at its most likely precision.
    best = float(gain.max())
    return best - 0.5 * (1.0 + math.log(max(2.0 * best, 1.0))) - math.log(len(products))


def _residual(under: Fitter, fit: Fit, linearised: Linearised) -> Tensor:
    """Whitened residual and prior residual of the parameters, (S C + P, 1)."""
    off = under.priors(fit.space, fit.theta)[2]
    return torch.cat([under.white(linearised)[0][0].flatten(), -off]).unsqueeze(1)


def _parameter_basis(under: Fitter, fit: Fit) -> tuple[Tensor, int]:
    """Orthonormal basis (S C + P, P) of the parameters' influence, and its number of rows."""
    scale, pull, _ = under.priors(fit.space, fit.theta)
    jacobian = (under.white(fit.linearised)[1][0] * scale).flatten(0, 1)
    rows = torch.cat([jacobian, torch.diag(pull + 1e-9)])
    return torch.linalg.qr(rows)[0], len(rows)


def _adjoints(regression: DiscrepancyRegression, under: Fitter, columns: Tensor, basis: Tensor) -> _Adjoints:
    readings = _whitened_adjoint(under, columns, basis)
    inflows, rates = [], []
    for piece in regression.pieces:
        by_rate = piece.to_rates(readings[piece.rows])
        rates.append(by_rate)
        inflows.append(piece.forcing.by_rates(by_rate))
    return _Adjoints(readings, inflows, rates)


def _whitened_adjoint(under: Fitter, columns: Tensor, basis: Tensor) -> Tensor:
    remaining = columns - basis @ (basis.T @ columns)
    shape = under.data.mask.shape
    assert under.whitening is not None
    return under.whitening.transposed(remaining[: shape.numel()].reshape(*shape, -1))


def _flow_products(regression: DiscrepancyRegression, place: str, adjoints: _Adjoints) -> Tensor:
    component = discrepancy_model_at(place, regression.fitter.data.plant)
    shared, per_recording = list[Tensor](), list[Tensor]()
    for regressors, inflows, rates in zip(regression.regressors(place), adjoints.inflows, adjoints.rates, strict=True):
        net = torch.zeros_like(inflows[0])
        for end, sign in ((component.source, -1.0), (component.target, 1.0)):
            if end != OUTSIDE:
                net += sign * inflows[regression.tank(end)]
        products = regressors.flows @ net.T
        if regressors.areas is not None:
            products = torch.cat([regressors.areas @ rates[regression.tank(component.target)].T, products])
        shared.append(products)
        per_recording.append(regressors.in_time @ net.T)
    return torch.cat([torch.stack(shared).sum(dim=0), *per_recording])


def _sensor_products(
    discrepancy: Discrepancy, under: Fitter, fit: Fit, basis: Tensor, adjoints: _Adjoints, channel: int
) -> Tensor:
    """Products for a sensor, about the model's level of its tank."""
    residual = _whitened_adjoint(under, _residual(under, fit, discrepancy.linearised), basis)
    weights = torch.cat([residual[:, channel], adjoints.readings[:, channel, 1:]], dim=1)
    return discrepancy.columns[:, channel].T @ weights
