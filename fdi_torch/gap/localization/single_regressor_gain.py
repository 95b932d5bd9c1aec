"""What one form of each component promises, to first order, by a few walks back through time.

With the columns C of all forms less what the parameters of a fit can do, the residual r and random signs z,

    score = C'r,    gram's diagonal = E[(C'z)^2]       (Hutchinson, 1990: products with random signs)

need only what r and z, taken back through the noise's whitening, the sensors and the linearised plant, say of a flow
into each tank at each time: the forms of a whole network cost hardly more than those of one component. It tells where a
regression (survey.py) is worth its cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.localization.component_regressors import component_at
from fdi_torch.gap.localization.discrepancy_regression import Discrepancy, DiscrepancyRegression
from fdi_torch.plant.description import OUTSIDE
from fdi_torch.simulate.collocation import Linearised

SIGNS = 64  # random ones: the gram's diagonal to a fifth


@dataclass(frozen=True)
class _Taken:
    """What residual and signs (1 + SIGNS) say of each reading (S, C, .), and of the flows into each tank and the rate
    of its level, (tanks, ., K) of each recording."""

    readings: Tensor
    inflows: list[Tensor]
    rates: list[Tensor]


def single_regressor_gains(
    survey: DiscrepancyRegression, under: Fitter, fit: Fit, places: Sequence[str], generator: torch.Generator
) -> dict[str, float]:
    """Log evidence of the likeliest single form at each place, over none. under: the fitter under a noise."""
    sensors = [s.name for s in survey.fitter.data.plant.sensors]
    basis, rows = _explained(under, fit)
    signs = torch.randint(0, 2, (rows, SIGNS), generator=generator, dtype=torch.float64) * 2.0 - 1.0
    taken = _taken_back(survey, under, torch.cat([_residual(under, fit, survey.linearised), signs], dim=1), basis)
    found = {}
    for place in places:
        if place in sensors:
            products = _of_sensor(survey.of(place), under, fit, basis, taken, sensors.index(place))
        else:
            products = _of_flows(survey, place, taken)
        found[place] = _likeliest(products)
    return found


def _likeliest(products: Tensor) -> float:
    """products (M, 1 + SIGNS): of the columns with the residual and with signs."""
    gain = 0.5 * products[:, 0].square() / products[:, 1:].square().mean(dim=1).clamp(min=1e-12)
    # A form that takes G from chi-square costs half of 1 + log G nats at its most likely precision.
    best = float(gain.max())
    return best - 0.5 * (1.0 + math.log(max(2.0 * best, 1.0))) - math.log(len(products))


def _residual(under: Fitter, fit: Fit, linearised: Linearised) -> Tensor:
    """(S C + P, 1): what is whitened, and what is left of the priors."""
    off = under.priors(fit.space, fit.theta)[2]
    return torch.cat([under.white(linearised)[0][0].flatten(), -off]).unsqueeze(1)


def _explained(under: Fitter, fit: Fit) -> tuple[Tensor, int]:
    """An orthonormal basis (S C + P, P) of what the parameters can do, and how many rows."""
    scale, pull, _ = under.priors(fit.space, fit.theta)
    jacobian = (under.white(fit.linearised)[1][0] * scale).flatten(0, 1)
    rows = torch.cat([jacobian, torch.diag(pull + 1e-9)])
    return torch.linalg.qr(rows)[0], len(rows)


def _taken_back(survey: DiscrepancyRegression, under: Fitter, columns: Tensor, basis: Tensor) -> _Taken:
    readings = _through_whitening(under, columns, basis)
    inflows, rates = [], []
    for piece in survey.pieces:
        by_rate = piece.seen_from(readings[piece.rows])
        rates.append(by_rate)
        inflows.append(piece.along.by_rates(by_rate))
    return _Taken(readings, inflows, rates)


def _through_whitening(under: Fitter, columns: Tensor, basis: Tensor) -> Tensor:
    left = columns - basis @ (basis.T @ columns)
    shape = under.data.mask.shape
    assert under.whitening is not None
    return under.whitening.transposed(left[: shape.numel()].reshape(*shape, -1))


def _of_flows(survey: DiscrepancyRegression, place: str, taken: _Taken) -> Tensor:
    component = component_at(place, survey.fitter.data.plant)
    shared, own = list[Tensor](), list[Tensor]()
    for forms, inflows, rates in zip(survey.forms(component), taken.inflows, taken.rates, strict=True):
        between = torch.zeros_like(inflows[0])
        for end, sign in ((component.source, -1.0), (component.target, 1.0)):
            if end != OUTSIDE:
                between += sign * inflows[survey.tank(end)]
        products = forms.flows @ between.T
        if forms.areas is not None:
            products = torch.cat([forms.areas @ rates[survey.tank(component.target)].T, products])
        shared.append(products)
        own.append(forms.in_time @ between.T)
    return torch.cat([torch.stack(shared).sum(dim=0), *own])


def _of_sensor(found: Discrepancy, under: Fitter, fit: Fit, basis: Tensor, taken: _Taken, channel: int) -> Tensor:
    """About what the model makes of the sensor's tank while the others are as they were read."""
    own = _through_whitening(under, _residual(under, fit, found.linearised), basis)
    weights = torch.cat([own[:, channel], taken.readings[:, channel, 1:]], dim=1)
    return found.columns[:, channel].T @ weights
