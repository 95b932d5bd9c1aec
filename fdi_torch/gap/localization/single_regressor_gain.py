"""First-order gain of the best single regressor of each place, by one adjoint pass.

With the columns C of all regressors, the parameters of a fit projected out, the residual r and random signs z,

    score = C'r,    diag(C'C) = E[(C'z)^2]       (Hutchinson, 1990)

need only r and z mapped back through the noise whitening, the sensors and the linearised plant to the flow into each
tank at each time. A whole network costs hardly more than one component. The result tells for which places the full
regression (`discrepancy_regression.py`) is worth its computing time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from fdi_torch.estimate.linear_parameters import decomposed, without
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_regression import DiscrepancyRegression
from fdi_torch.gap.localization.regressor_families import Pulses
from fdi_torch.gap.localization.sparse_regression import regressor_costs
from fdi_torch.simulate.linearised import Linearised

SIGNS = 64  # random sign vectors; the diagonal of C'C is then accurate to about 20 %


@dataclass(frozen=True)
class Adjoints:
    """Whitened columns, such as a residual and random signs, mapped back to the readings (S, C, .), and per recording
    to the flows into each tank and the rates of its level, (tanks, ., K)."""

    readings: Tensor
    inflows: list[Tensor]
    rates: list[Tensor]


class SingleRegressorGain(NamedTuple):
    """Gain in log evidence of one regressor without the cost of its selection, nats; and this cost."""

    gain: float
    cost: float

    @property
    def net(self) -> float:
        return self.gain - self.cost


class SingleRegressorGains:
    """Gain in log evidence of the best single regressor of a place, under each of some noise models.

    under: for each, the fitter with the disturbance noise.
    """

    def __init__(self, regression: DiscrepancyRegression, under: Sequence[Fitter], generator: torch.Generator) -> None:
        self.regression, self.under, self._largest = regression, under, largest_influence(regression.fitter)
        fit, linearised = regression.fit, regression.linearised
        residuals = [whitened_residual(each, fit, linearised) for each in under]
        signs = random_signs(residuals[0], generator)
        readings = [
            _whitened_adjoint(each, torch.cat([residual, signs], dim=1), parameter_basis(each, fit, linearised))
            for each, residual in zip(under, residuals, strict=True)
        ]
        self._adjoints = _mapped_back(regression, torch.cat(readings, dim=-1))

    def at(self, place: str) -> list[SingleRegressorGain]:
        weights = weights_of(self.regression, place, self._adjoints_at(place))
        grid, families = self._products(place, weights), position_products(self.regression, place, weights)
        groups = [(grid, len(grid)), *zip(families, choices_of(self.regression, place), strict=True)]
        gains = [self._largest_gains(group, choices) for group, choices in groups if len(group)]
        return [max(of_noise, key=lambda g: g.net) for of_noise in zip(*gains, strict=True)]

    def _adjoints_at(self, place: str) -> Adjoints:
        """The adjoints at a place. For a sensor, the residual is that about the simulated level of its tank."""
        if self.regression.sensor(place) is None:
            return self._adjoints
        fit, linearised = self.regression.fit, self.regression.at(place)[1]
        readings = self._adjoints.readings.clone()
        for under, columns in zip(self.under, readings.split(1 + SIGNS, dim=-1), strict=True):
            residual, basis = whitened_residual(under, fit, linearised), parameter_basis(under, fit, linearised)
            columns[..., :1] = _whitened_adjoint(under, residual, basis)
        return replace(self._adjoints, readings=readings)

    def _largest_gains(self, products: Tensor, choices: int) -> list[SingleRegressorGain]:
        """Largest gain among regressors under each noise. products: as `_products`. choices: number of regressors among
        which one is selected."""
        (cost,) = regressor_costs(torch.tensor([float(choices)]), self._largest).tolist()
        return [
            SingleRegressorGain(float(gains_of(each[:, 0], strengths_of(each[:, 1:])).max()), cost)
            for each in products.split(1 + SIGNS, dim=1)
        ]

    def _products(self, place: str, weights: Sequence[Tensor]) -> Tensor:
        """Products (M, N (1 + SIGNS)) of the regressors of the grids with the weights of N noise models."""
        shared, per_recording = list[Tensor](), list[Tensor]()
        for k, (regressors, net) in enumerate(zip(self.regression.at(place)[0], weights, strict=True)):
            products = regressors.functions @ net.T
            if regressors.areas is not None:
                rates = self._adjoints.rates[k][self.regression.tank(place)]
                products = torch.cat([regressors.areas @ rates.T, products])
            shared.append(products)
            sinusoids = regressors.sinusoids(self.regression.frequencies).flatten(0, 1)
            per_recording.append(torch.cat([regressors.in_time, sinusoids]) @ net.T)
        return torch.cat([torch.stack(shared).sum(dim=0), *per_recording])


def position_products(regression: DiscrepancyRegression, place: str, weights: Sequence[Tensor]) -> list[Tensor]:
    """Products (N, W) of the regressors at all positions with weights (W, K) per recording, by `families`."""
    pairs = list(zip(regression.at(place)[0], weights, strict=True))
    fine = [[b.products(w) for b in r.fine] for r, w in pairs]
    shared = [torch.stack(of_family).sum(dim=0) for of_family in zip(*fine, strict=True)]
    return [*shared, *(b.products(w) for r, w in pairs for b in r.fine_in_time)]


def choices_of(regression: DiscrepancyRegression, place: str) -> list[int]:
    """Number of regressors among which one of each of the `families` is selected.

    A pulse is as likely as all other regressors together, of which there are far fewer.
    """
    families = regression.families(place)
    total = {pulses: sum(len(f) for f in families if isinstance(f, Pulses) is pulses) for pulses in (True, False)}
    return [len(total) * total[isinstance(f, Pulses)] for f in families]


def largest_influence(fitter: Fitter) -> float:
    """Largest conceivable influence on the readings: the range of each, in units of its noise."""
    readings, total = fitter.data.readings, 1.0
    for c, std in enumerate(fitter.noise.std.tolist()):
        valid = readings[fitter.data.mask[:, c], c]
        if len(valid):
            total += len(valid) * (float(valid.max() - valid.min()) / std) ** 2
    return math.sqrt(total)


def random_signs(residual: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randint(0, 2, (len(residual), SIGNS), generator=generator, dtype=torch.float64) * 2.0 - 1.0


def gains_of(score: Tensor, strength: Tensor) -> Tensor:
    """Gain in log evidence of each regressor (M,), without its cost (`regressor_costs`).

    score (M,): product of its column with the residual. strength (M,): squared norm of its column.
    """
    gain = 0.5 * score.square() / strength.clamp(min=1e-12)
    # A regressor that reduces chi-square by G costs (1 + log G) / 2 nats at its most likely precision.
    return gain - 0.5 * (1.0 + torch.log((2.0 * gain).clamp(min=1.0)))


def strengths_of(products: Tensor) -> Tensor:
    """Squared norm of each column (M,), from its products with random signs (M, SIGNS)."""
    return products.square().mean(dim=1)


def whitened_residual(under: Fitter, fit: Fit, linearised: Linearised) -> Tensor:
    """Whitened residual of the readings, and below it that of the parameters' priors: (S C + P, 1)."""
    off = under.priors(fit.space, fit.theta)[2]
    return torch.cat([under.residual(linearised.readings).flatten(), -off]).unsqueeze(1)


def parameter_basis(
    under: Fitter,
    fit: Fit,
    linearised: Linearised,
    columns: Tensor | None = None,
    precision: Tensor | None = None,
) -> Tensor:
    """Orthonormal basis (S C + P + M, .) of the influence of the parameters about a linearised trajectory, and of
    further columns (S, C, M), on the readings and on the priors. precision (M,): of the coefficients of the columns."""
    scale, pull, _ = under.priors(fit.space, fit.theta)
    jacobian = under.whiten(linearised.jacobian[0]) * scale
    if columns is not None and precision is not None:
        jacobian, pull = torch.cat([jacobian, under.whiten(columns)], dim=-1), torch.cat([pull, precision.sqrt()])
    return decomposed(jacobian.flatten(0, 1), pull)[0]


def adjoints_of(regression: DiscrepancyRegression, under: Fitter, columns: Tensor, basis: Tensor) -> Adjoints:
    """Columns (S C + P, .) without what the basis explains, mapped back."""
    return _mapped_back(regression, _whitened_adjoint(under, columns, basis))


def _mapped_back(regression: DiscrepancyRegression, readings: Tensor) -> Adjoints:
    """The adjoints of columns that were mapped back to the readings (S, C, .)."""
    inflows, rates = [], []
    for piece in regression.pieces:
        by_rate = piece.to_rates(readings[piece.rows])
        rates.append(by_rate)
        inflows.append(piece.forcing.by_rates(by_rate))
    return Adjoints(readings, inflows, rates)


def _whitened_adjoint(under: Fitter, columns: Tensor, basis: Tensor) -> Tensor:
    remaining = without(basis, columns)
    shape = under.data.mask.shape
    whitening = under.whitening
    assert whitening is not None
    return whitening.transposed(remaining[: shape.numel()].reshape(*shape, -1))


def weights_of(regression: DiscrepancyRegression, place: str, adjoints: Adjoints) -> list[Tensor]:
    """Per recording, the weights (., K) of a flow at a place, or of a sensor's readings."""
    if (channel := regression.sensor(place)) is not None:
        return [adjoints.readings[piece.rows, channel].T for piece in regression.pieces]
    ends = regression.ends(place)
    return [torch.stack([sign * inflows[tank] for tank, sign in ends]).sum(dim=0) for inflows in adjoints.inflows]
