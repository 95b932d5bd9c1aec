"""Fine search for the position of the next regressor of a discrepancy: the level of a kink, jump or relay, the time of
a step, or the frequency of a sinusoid at which it explains most.

The grids of `regressors.py` are coarse. Where a discrepancy is many times the noise, a law with a kink between two
nodes, or a change between two steps in time, would need many regressors of the grid. As in orthogonal matching pursuit
(Pati, Rezaiifar and Krishnaprasad, 1993), the next regressor is the one with the largest gain in addition to all that
were selected before: among kinks, jumps and relays on fine grids and steps in time at every step. One adjoint pass
compares all of them. The thresholds of a relay are then moved to where it explains most.

The spectrum of a residual shows a frequency to about 1/T in a recording of length T. The phase is then wrong by up to
half a turn at its ends, which may cost hundreds of nats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import TOLERANCE
from fdi_torch.estimate.linear_parameters import without
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_columns import Discrepancy, Position
from fdi_torch.gap.localization.discrepancy_regression import DiscrepancyRegression
from fdi_torch.gap.localization.regressor_families import Pulses, Relays
from fdi_torch.gap.localization.regressors import HARMONICS
from fdi_torch.gap.localization.single_regressor_gain import (
    SIGNS,
    adjoints_of,
    choices_of,
    gains_of,
    largest_influence,
    parameter_basis,
    position_products,
    random_signs,
    strengths_of,
    weights_of,
    whitened_residual,
)
from fdi_torch.gap.localization.sparse_regression import COLLINEAR, VISIBLE, regressor_costs

TRIED = 8  # positions, or frequencies, with the largest estimated gains, whose gains are computed exactly
HALVINGS = 4  # of the spacing between a relay's thresholds; then it is 1/16 of that of the fine grid
FREQUENCIES = 17  # from 1/T below a frequency to 1/T above it
FREQUENCY_ERROR = 1.0 / 600.0  # of the best frequency, in units of 1/T


class Positions:
    """All positions of a kink, a jump, a relay or a step in time at a place, and all frequencies of its sinusoids,
    for one noise model.

    under: fitter with the disturbance noise. precision (M,): of the columns of the discrepancy, infinite for those that
    are not used. The strength of each position is computed with these present; regressors that are added later only
    reduce it.
    """

    def __init__(
        self,
        regression: DiscrepancyRegression,
        place: str,
        under: Fitter,
        discrepancy: Discrepancy,
        precision: Tensor,
        generator: torch.Generator,
    ) -> None:
        self.regression, self.place, self.under, self.fit = regression, place, under, regression.fit
        self._residual = whitened_residual(under, self.fit, discrepancy.linearised)
        basis = self._basis(discrepancy, precision)
        self._signs = self._weights(random_signs(self._residual, generator), basis)

    def _basis(self, discrepancy: Discrepancy, precision: Tensor) -> Tensor:
        """The part of the readings that the parameters of the fit and the columns in use explain."""
        used = torch.isfinite(precision)
        columns = discrepancy.columns[used]
        return parameter_basis(self.under, self.fit, discrepancy.linearised, columns, precision[used])

    @cached_property
    def _strengths(self) -> list[Tensor]:
        return [strengths_of(p) for p in position_products(self.regression, self.place, self._signs)]

    @cached_property
    def _choices(self) -> list[int]:
        return choices_of(self.regression, self.place)

    @cached_property
    def _costs(self) -> list[float]:
        """Cost of one more regressor of each family, nats."""
        return regressor_costs(torch.tensor(self._choices, dtype=torch.float64), largest_influence(self.under)).tolist()

    def best(self, discrepancy: Discrepancy, precision: Tensor) -> Discrepancy | None:
        """The discrepancy with the regressor that explains most in addition to those used, or None if none is worth
        its selection. precision (M,): of its columns."""
        basis = self._basis(discrepancy, precision)
        products = position_products(self.regression, self.place, self._weights(self._residual, basis))
        gains = [gains_of(p[:, 0], strength) for p, strength in zip(products, self._strengths, strict=True)]
        highest = [
            (float(g[i]) - cost, family, i)
            for family, (g, cost) in enumerate(zip(gains, self._costs, strict=True))
            if len(g)
            for i in _local_maxima(g)
        ]
        tried = sorted(highest, reverse=True)[:TRIED]
        if not tried or tried[0][0] < 0.0:
            return None
        positions = [Position(family, index, self._choices[family]) for _, family, index in tried]
        columns = self.regression.columns(self.place, positions)
        costs = torch.tensor([self._costs[p.family] for p in positions], dtype=columns.dtype)
        best = int((self._exact_gains(columns, basis) - costs).argmax())
        family = self.regression.families(self.place)[positions[best].family]
        if isinstance(family, Relays | Pulses):
            return self._moved(discrepancy, basis, positions[best], family)
        return discrepancy.with_column(columns[..., best], positions[best])

    def _moved(
        self, discrepancy: Discrepancy, basis: Tensor, position: Position, family: Relays | Pulses
    ) -> Discrepancy:
        """The discrepancy with a relay or pulse whose parameters are moved to where it explains most."""

        def at(parameters: Tensor) -> list[Position]:
            return [replace(position, parameters=tuple(p)) for p in parameters.tolist()]

        def columns(parameters: Tensor) -> Tensor:
            return self.regression.columns(self.place, at(parameters))

        start = family.parameters(position.index)
        best = best_parameters(
            lambda tried: self._exact_gains(columns(tried), basis), start, family.spacing, family.possible
        )
        (moved,) = at(best.unsqueeze(0))
        moved = replace(
            moved,
            choices=position.choices + len(family) * 2 ** (HALVINGS * len(best)),
            frequency=float(best[0]) if isinstance(family, Pulses) else None,
        )
        return discrepancy.with_column(columns(best.unsqueeze(0))[..., 0], moved)

    def _exact_gains(self, columns: Tensor, basis: Tensor) -> Tensor:
        """Gains (M,) of influences (S, C, M) in addition to those in the basis."""
        white = without(basis, self.under.whiten(columns).flatten(0, 1))
        return gains_of((white[: len(self._residual)].T @ self._residual).squeeze(1), white.square().sum(dim=0))

    def _weights(self, white: Tensor, basis: Tensor) -> list[Tensor]:
        """Whitened columns (S C + P, W), less what the basis explains of these, as weights (W, K) of a regressor along
        each recording."""
        return weights_of(self.regression, self.place, adjoints_of(self.regression, self.under, white, basis))

    def with_best_frequency(self, discrepancy: Discrepancy, precision: Tensor) -> Discrepancy:
        """The discrepancy with the frequency at which its sinusoids explain most beside the other regressors that it
        uses; the same if it has no sinusoids. precision (M,): as given at the construction, without sinusoids.
        """
        if discrepancy.frequency is None:
            return discrepancy
        basis = self._basis(discrepancy, precision)
        weights = self._weights(self._residual, basis)

        def estimated(frequencies: Tensor, harmonics: slice) -> Tensor:
            each = zip(self.regression.at(self.place)[0], weights, self._signs, strict=True)
            products = [r.sinusoids(frequencies)[:, harmonics] @ torch.cat([w, signs]).T for r, w, signs in each]
            score, signs = torch.cat(products, dim=1).split([1, SIGNS], dim=2)
            return _reductions(score, signs @ signs.mT / SIGNS)

        def exact(frequencies: Tensor, harmonics: slice) -> Tensor:
            columns = self.regression.sinusoids(self.place, frequencies)[..., harmonics]
            white = without(basis, self.under.whiten(columns.flatten(2)).flatten(0, 1))
            white = white.unflatten(1, columns.shape[2:]).transpose(0, 1)  # (F, S C + P, W)
            return _reductions(white[:, : len(self._residual)].mT @ self._residual, white.mT @ white)

        # Without harmonics: a third of a frequency would explain as much by its third harmonic.
        fundamental, whole = slice(None, None, HARMONICS), slice(None)
        candidates = torch.cat([self.regression.frequencies, self._residual.new_tensor([discrepancy.frequency])])
        tried = candidates[estimated(candidates, fundamental).argsort(descending=True)[:TRIED]]
        first = tried[exact(tried, fundamental).argmax()]
        unit = 1.0 / self.under.data.longest_duration
        around = (first + unit * torch.linspace(-1.0, 1.0, FREQUENCIES, dtype=first.dtype)).clamp(min=unit)
        near, spacing = float(around[estimated(around, whole).argmax()]), 2.0 * unit / (FREQUENCIES - 1)

        from scipy.optimize import minimize_scalar  # it takes 0.3 s to load

        best = minimize_scalar(
            lambda frequency: -float(exact(first.new_tensor([frequency]), whole)),
            bounds=(max(near - spacing, unit), near + spacing),
            options={"xatol": FREQUENCY_ERROR * unit},
        )
        columns = self.regression.sinusoids(self.place, first.new_tensor([best.x]))
        return discrepancy.with_sinusoids(float(best.x), columns[:, :, 0])


def _reductions(score: Tensor, gram: Tensor) -> Tensor:
    """Reduction of chi-square (F,) by the columns of each frequency. score (F, W, 1): their products with the residual.
    gram (F, W, W): with each other."""
    gram = gram + torch.diag_embed(COLLINEAR * torch.diagonal(gram, dim1=1, dim2=2) + VISIBLE)
    return (score * torch.linalg.solve(gram, score)).sum(dim=(1, 2))


def best_parameters(
    gains: Callable[[Tensor], Tensor], start: Tensor, spacing: Tensor, possible: Callable[[Tensor], Tensor]
) -> Tensor:
    """The parameters (P,) with the largest gain near the first ones, by pattern search (Hooke and Jeeves, 1961).

    gains: of parameters (M, P), nats. spacing (P,): of the first moves; it is halved HALVINGS times. possible: whether
    parameters (M, P) may be tried, (M,) bool.
    """
    best, largest = start, float(gains(start.unsqueeze(0)))
    for halving in range(HALVINGS + 1):
        while True:
            tried = around(best, spacing / 2.0**halving)
            tried = tried[possible(tried)]
            gained = gains(tried)
            k = int(gained.argmax())
            if not float(gained[k]) > largest + TOLERANCE:
                break
            best, largest = tried[k], float(gained[k])
    return best


def around(parameters: Tensor, spacing: Tensor) -> Tensor:
    """Parameters (M, P) each of which differs from the first ones (P,) by its spacing at most."""
    return parameters + torch.cartesian_prod(*(s * s.new_tensor([-1.0, 0.0, 1.0]) for s in spacing))


def _local_maxima(gains: Tensor) -> list[int]:
    """Positions (M,) at which a gain is as large as at both neighbours, the largest first; at most TRIED."""
    around = torch.nn.functional.max_pool1d(gains.reshape(1, 1, -1), 3, 1, 1).flatten()
    order = torch.where(gains == around, gains, -torch.inf).argsort(descending=True)[:TRIED]
    return order.tolist()
