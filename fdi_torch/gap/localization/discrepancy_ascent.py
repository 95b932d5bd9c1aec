"""The most probable discrepancy at a place: its noise, its regressors and the fit's parameters are improved in turn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import TOLERANCE
from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_columns import Discrepancy, Selection
from fdi_torch.gap.localization.discrepancy_regression import DiscrepancyRegression
from fdi_torch.gap.localization.fine_positions import Positions
from fdi_torch.gap.localization.localized_discrepancy import (
    Estimate,
    LocalizedDiscrepancy,
    log_likelihood,
    unexplained_norm,
)
from fdi_torch.gap.localization.predicted_levels import LevelFilter
from fdi_torch.gap.localization.single_regressor_gain import largest_influence
from fdi_torch.gap.localization.sparse_regression import SparseFit, regressor_costs
from fdi_torch.gap.localization.whitened_discrepancy import WhitenedDiscrepancy
from fdi_torch.gap.marginal_likelihood import LinearParameters, estimate_disturbances, with_disturbances
from fdi_torch.gap.trajectory_problem import GIVE_UP_SHARE

LESS_NOISE = (0.3, 0.1, 0.03, 0.01)  # random flows in successive regressions, as shares of the likeliest without one
MOST_REGRESSORS = 100  # that a relevant law needs; a regression that so many steps would not save is given up
MOST_TURNS = 12  # alternations between the disturbance noise, one more regressor, and the parameters of the fit


@dataclass(frozen=True)
class EvaluatedDiscrepancy:
    """A discrepancy at a place under one disturbance noise, that of the fitter `under`.

    without, gain: in log evidence against the fit alone, without and with the discrepancy's regressors.
    """

    location: str
    noise: StateNoise
    under: Fitter
    regression: DiscrepancyRegression
    discrepancy: Discrepancy
    whitened: WhitenedDiscrepancy
    regressed: SparseFit
    without: float

    @property
    def gain(self) -> float:
        return self.without + self.regressed.evidence

    @property
    def log_likelihood(self) -> float:
        return self.without + self.regressed.reduction

    @cached_property
    def estimate(self) -> Estimate:
        """The parameters of the fit beside the regressors."""
        used = self.regressed.used
        columns, precision = self.discrepancy.columns[used], self.regressed.precision[used]
        return Estimate.beside(self.under, self.regression.fit, self.discrepancy.linearised, columns, precision)

    @property
    def held(self) -> Mapping[str, float]:
        """Parameters of the effects at the place. They stay fixed: the discrepancy is the error of their laws."""
        fit = self.regression.fit
        return fit.values_of([p for p in fit.candidate.placements if p.location == self.location])

    @cached_property
    def explained(self) -> Tensor:
        """The part of the readings (S, C) that the discrepancy explains, beside the effects at its place as they are.

        Regressors and such an effect may nearly cancel, so that the change of the effect belongs to the discrepancy.
        """
        used, fit, at = self.regressed.used, self.regression.fit, self.discrepancy
        held = [fit.space.index(name) for name in self.held if name in fit.space]
        change = (self.estimate.values - fit.theta)[held]
        return at.columns[used] @ self.regressed.mean[used] + at.linearised.jacobian[0][..., held] @ change

    @property
    def selection(self) -> Selection:
        return self.discrepancy.selection(self.regressed.precision)

    def localized(self, fitter: Fitter) -> LocalizedDiscrepancy:
        """The result. fitter: that of the explanation, whose sensor noise is the unit of the size."""
        explained, at, fit = self.explained, self.discrepancy, self.regression.fit
        size = unexplained_norm(fitter, fit.space, fit.theta, at.linearised.jacobian[0], explained)
        return LocalizedDiscrepancy(
            location=self.location,
            gain=self.gain,
            log_likelihood=self.log_likelihood,
            parameters=self.regressed.parameters,
            explained=explained,
            predicted=at.linearised.readings[0] + explained,
            size=size,
            selection=self.selection,
            fit=fit,
            noise=self.noise,
            estimate=self.estimate,
            level_filter=self.regression.level_filter,
            quantities=self._quantities,
        )

    @property
    def _quantities(self) -> frozenset[str]:
        """What the selected regressors change: 'area' (the cross-section of a tank), 'flow', or both.

        `regressed.used` lists the regressors that act on the area before those that act on a flow.
        """
        areas = self.regression.at(self.location)[0][0].areas
        of_area, of_flow = self.regressed.used.tensor_split([0 if areas is None else len(areas)])
        return frozenset(name for name, used in (("area", of_area), ("flow", of_flow)) if bool(used.any()))


def gain_of(discrepancy: EvaluatedDiscrepancy | LocalizedDiscrepancy) -> float:
    return discrepancy.gain


class DiscrepancyAscent:
    """Maximises the evidence of a discrepancy beside a fit: over its noise, its regressors, and the fit's parameters.

    fitter: with the disturbance noise without the discrepancy. level_filter: predicts the levels. base: log evidence of
    the fit alone.
    """

    def __init__(self, fitter: Fitter, level_filter: LevelFilter, base: float) -> None:
        self.fitter, self.level_filter, self.base = fitter, level_filter, base
        self.largest, self.generator = largest_influence(fitter), torch.Generator().manual_seed(0)

    def evaluate(
        self,
        regression: DiscrepancyRegression,
        discrepancy: Discrepancy,
        place: str,
        noise: StateNoise,
        start: Tensor | None = None,
        exchanges: bool = False,
    ) -> EvaluatedDiscrepancy:
        """The most probable discrepancy for one noise model.

        start (M,): precisions of its columns from which the regression starts. Without it, the regression starts from
        nothing, and the regressor at the best of all positions is one more column: a stiction whose band lies between
        two of the grid would need ten of its regressors, after which no position gains any more. exchanges: as in
        `sparse_fit`.
        """
        fit = regression.fit
        under = with_disturbances(self.fitter, fit, noise, discrepancy.linearised)
        if start is None:
            nothing = torch.full_like(discrepancy.choices, math.inf)
            positions = Positions(regression, place, under, discrepancy, nothing, self.generator)
            discrepancy = positions.with_best_frequency(discrepancy, nothing)
            discrepancy = positions.best(discrepancy, nothing) or discrepancy
        whitened = WhitenedDiscrepancy(under, fit, discrepancy)
        costs = regressor_costs(discrepancy.choices, self.largest)
        regressed = whitened.sparse_fit(discrepancy.regressor, costs, start, exchanges=exchanges)
        without = log_likelihood(under, fit, discrepancy.linearised, bounded=False) + noise.log_prior() - self.base
        return EvaluatedDiscrepancy(place, noise, under, regression, discrepancy, whitened, regressed, without)

    def about(
        self, fit: Fit, explained: Tensor, noise: StateNoise, place: str, selection: Selection
    ) -> EvaluatedDiscrepancy:
        """The discrepancy evaluated about another fit, whose levels are predicted from readings without the error that
        a discrepancy at a sensor would be.

        explained: part of the readings (S, C) that the discrepancy explains. selection: the regressors from which the
        regression starts. A regression that starts without regressors selects about a hundred if little noise is left.
        """
        data, right = self.fitter.data, Fitter(self.fitter.data, self.fitter.noise)
        if any(s.name == place for s in data.plant.sensors):
            right = Fitter(replace(data, readings=data.readings - explained), self.fitter.noise)
        regression = DiscrepancyRegression(right, fit, selection.frequencies, self.level_filter)
        return self.evaluate(regression, regression.of(place, selection.positions), place, noise, selection.precision)

    def with_decreasing_noise(
        self, regression: DiscrepancyRegression, place: str, noise: StateNoise
    ) -> EvaluatedDiscrepancy:
        """The likeliest discrepancy at a place under this noise or under ones with smaller random flows.

        Random flows that absorb a law with many changes hide each of them, so that neither one more regressor nor
        smaller flows gain anything, but both together do. The intensity of the random flows is therefore reduced in
        steps, and each regression starts from the regressors of the previous one, until two successive ones are worse.
        """
        evaluated = [self.with_finer_positions(self.evaluate(regression, regression.of(place), place, noise))]
        for share in LESS_NOISE:
            last, less = evaluated[-1], replace(noise, intensity=share * noise.intensity)
            current = self.evaluate(regression, last.discrepancy, place, less, last.regressed.precision)
            evaluated.append(self.with_finer_positions(current, max(map(gain_of, evaluated))))
            if len(evaluated) > 2 and evaluated[-3].gain > max(evaluated[-2].gain, evaluated[-1].gain):
                break
        return max(evaluated, key=gain_of)

    def climbed(self, best: EvaluatedDiscrepancy, needed: float) -> EvaluatedDiscrepancy:
        """Improve noise, regressors and fit parameters in turn, until nothing gains or `needed` is out of reach."""
        not_refitted = -math.inf  # largest gain from which a refit gained nothing
        for turn in range(MOST_TURNS):
            before, best = best.gain, max(best, self._with_likely_noise(best, turn == 0), key=gain_of)
            best = self.with_finer_positions(best)
            if turn == 0 or bool((best.regressed.used & best.discrepancy.sinusoids).any()):
                best = max(best, self._with_finer_frequency(best), key=gain_of)
            if best.gain < max(not_refitted + TOLERANCE, GIVE_UP_SHARE * (needed - best.gain)):
                break
            refitted = self._refitted(best)
            if refitted.gain > best.gain:
                best = refitted
            else:
                not_refitted = best.gain
            if best.gain - before < max(TOLERANCE, GIVE_UP_SHARE * (needed - best.gain)):
                break
        return best

    def with_finer_positions(self, current: EvaluatedDiscrepancy, least: float = -math.inf) -> EvaluatedDiscrepancy:
        """The discrepancy with further regressors under the same noise, until none is worth its selection.

        The estimated noise falls only after most of them were added, so that each alone seems to gain little. least:
        gain that matters; where random flows are far too small, hundreds of regressors do not reach it.
        """
        at, precision = current.discrepancy, current.regressed.precision
        positions = Positions(current.regression, current.location, current.under, at, precision, self.generator)
        while finer := positions.best(current.discrepancy, current.regressed.precision):
            extended = self._changed(current, finer)
            gain = extended.gain - current.gain
            if gain < TOLERANCE or current.gain + MOST_REGRESSORS * gain < least:
                break
            current = extended
        return current

    def _with_finer_frequency(self, current: EvaluatedDiscrepancy) -> EvaluatedDiscrepancy:
        at = current.discrepancy
        others = torch.where(at.sinusoids, math.inf, current.regressed.precision)
        if at.frequency is None:
            return current
        positions = Positions(current.regression, current.location, current.under, at, others, self.generator)
        return self._changed(current, positions.with_best_frequency(at, others))

    def _changed(self, current: EvaluatedDiscrepancy, discrepancy: Discrepancy) -> EvaluatedDiscrepancy:
        """The evaluated discrepancy, with other values of some columns."""
        whitened = current.whitened.with_columns(discrepancy.columns)
        costs = regressor_costs(discrepancy.choices, self.largest)
        regressed = whitened.sparse_fit(discrepancy.regressor, costs, current.regressed.precision)
        return replace(current, discrepancy=discrepancy, whitened=whitened, regressed=regressed)

    def _with_likely_noise(self, current: EvaluatedDiscrepancy, climb: bool) -> EvaluatedDiscrepancy:
        at, used = current.discrepancy, current.regressed.used
        coefficients = LinearParameters(at.columns[used], torch.sqrt(current.regressed.precision[used]))
        fit = current.regression.fit
        likely = estimate_disturbances(self.fitter, fit, at.linearised, coefficients, current.noise, climb).noise
        return self.evaluate(
            current.regression, at, current.location, likely, current.regressed.precision, exchanges=True
        )

    def _refitted(self, current: EvaluatedDiscrepancy) -> EvaluatedDiscrepancy:
        """The discrepancy with the parameters of the fit refitted beside it, and the levels predicted anew."""
        data, fit = self.fitter.data, current.regression.fit
        corrected = replace(data, readings=data.readings - current.explained)
        candidate = Candidate(fit.candidate.placements, (fit.effect_values,))
        new = current.under.of(corrected).fit(candidate, fit, held=current.held)
        return self.about(new, current.explained, current.noise, current.location, current.selection)
