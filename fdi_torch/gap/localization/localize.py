"""Ranking of the places of a discrepancy by evidence, whatever the law of the discrepancy.

A discrepancy is a linear combination of a few regressors of the component's own variables (`regressors.py`), about the
predicted trajectory. The log evidence is that of a sparse regression (`sparse_regression.py`), with each regressor
selected among all of the component, under the disturbance noise that is most likely with the discrepancy (as for named
effects: `marginal_likelihood.py`). Random processes at one tank or sensor compete with these (`random_processes.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import RARE
from fdi_torch.estimate.kalman import StateNoise
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_regression import Discrepancy, DiscrepancyRegression
from fdi_torch.gap.localization.fine_positions import Positions, with_best_frequency
from fdi_torch.gap.localization.localized_discrepancy import (
    LocalizedDiscrepancy,
    is_rounding_error,
    log_evidence,
    log_likelihood,
    nearly_without_disturbances,
    nearly_without_the_largest,
)
from fdi_torch.gap.localization.random_processes import drifting_sensors, random_flows
from fdi_torch.gap.localization.regressors import dominant_frequency
from fdi_torch.gap.localization.single_regressor_gain import largest_influence, single_regressor_gains
from fdi_torch.gap.localization.sparse_regression import SparseFit, column_costs
from fdi_torch.gap.localization.whitened_discrepancy import WhitenedDiscrepancy
from fdi_torch.gap.marginal_likelihood import LinearParameters, estimate_disturbances, occam, with_disturbances
from fdi_torch.gap.trajectory_problem import SHARE

STEPS = 120  # step functions of time
MOST_TURNS = 12  # alternations between the disturbance noise, one more regressor, and the parameters of the fit
CONVERGED = 0.1  # nats; a smaller gain ends the alternation, as does one below SHARE of what is still needed
CALIBRATION_PLACES = 3  # places always evaluated; they show by how much first-order gains are too low


@dataclass(frozen=True)
class Localization:
    """discrepancies: of the places that may be relevant, the likeliest first. itself: gain in log evidence of the fit
    without a discrepancy, if it is linearised where the discrepancies are, and not about its own trajectory."""

    discrepancies: tuple[LocalizedDiscrepancy, ...]
    itself: float


def localize(
    fitter: Fitter,
    fit: Fit,
    noise: StateNoise,
    places: Sequence[str],
    needed: float = -math.inf,
    rival: StateNoise | None = None,
) -> Localization:
    """Evaluate a discrepancy at each of the places.

    fitter: with the disturbance noise of the fit. needed: gain in log evidence below which a discrepancy is irrelevant;
    there are none in the result if none can reach it. rival: the noise that a likelier hypothesis left.
    """
    frequency = dominant_frequency(fitter.residual(fit.linearised.readings)[0], fitter.data.row_spacing)
    regression = DiscrepancyRegression(fitter, fit, frequency, STEPS)
    base = log_likelihood(fitter, fit, fit.linearised) + noise.log_prior()
    if not math.isfinite(base + log_evidence(fitter, fit, noise, regression.linearised)):
        return Localization((), 0.0)
    likely = estimate_disturbances(fitter, fit, regression.linearised, start=noise, climb=False).noise
    itself = max(log_evidence(fitter, fit, likely, regression.linearised) - base, 0.0)
    scale = torch.minimum(noise.scale, rival.scale) if rival else noise.scale
    if _evidence_bound(fitter, fit, replace(noise, scale=scale), regression.steps) - base < needed:
        return Localization((), itself)
    ascent = _Ascent(fitter, fit, noise, base)
    starts = [likely, nearly_without_disturbances(likely), nearly_without_the_largest(likely)]
    starts += [replace(rival, wander=None, apart=None)] if rival else []
    first_order = _first_order_gains(regression, starts, fit, places, base)
    evaluated: dict[str, _EvaluatedDiscrepancy] = {}
    excess = -math.inf  # largest difference seen so far between a gain and its first-order estimate
    for place, (expected, start) in sorted(first_order.items(), key=lambda item: -item[1][0]):
        if len(evaluated) >= CALIBRATION_PLACES and expected + excess < needed:
            break
        first = ascent.with_finer_positions(ascent.evaluate(regression, regression.of(place), place, start))
        found = ascent.climbed(first, needed)
        itself = max(itself, *(e.without for e in (first, found) if e.regression is regression))
        excess = max(excess, found.gain - expected)
        if not is_rounding_error(fitter, place, float(found.explained.square().mean(dim=0).max().sqrt())):
            needed, evaluated[place] = max(needed, found.gain + math.log(RARE)), found
    likeliest: _EvaluatedDiscrepancy | None = None
    while evaluated and (best := max(evaluated.values(), key=_gain)) is not likeliest:
        likeliest = best
        for place, known in evaluated.items():
            # A larger noise than that which the likeliest discrepancy left hides what another place explains as well.
            if known is not likeliest:
                again = ascent.evaluate(known.regression, known.discrepancy, place, likeliest.noise)
                again = ascent.climbed(ascent.with_finer_positions(again), needed)
                evaluated[place] = max(known, again, key=_gain)
    localized = [e.localized(fitter) for e in evaluated.values()]
    random = [*drifting_sensors(regression, likely, places, base, needed)]
    random += random_flows(regression, likely, places, base)
    for process in random:
        localized = [p for p in localized if p.location != process.location or p.gain > process.gain]
        if all(p.location != process.location for p in localized):
            localized.append(process)
    return Localization(tuple(sorted(localized, key=_gain, reverse=True)), itself)


def localize_beside(
    fitter: Fitter, fit: Fit, noise: StateNoise, at: LocalizedDiscrepancy, needed: float = -math.inf
) -> LocalizedDiscrepancy | None:
    """The discrepancy `at` of an explanation beside another one; None if there is none.

    fitter, noise: with the disturbance noise without the discrepancy. fit: of the readings without what the discrepancy
    explains of them. needed: gain in log evidence below which it is irrelevant.
    """
    base = log_likelihood(fitter, fit, fit.linearised) + noise.log_prior()
    if at.noise.wander or at.noise.apart is not None:
        regression = DiscrepancyRegression(fitter, fit, None, STEPS)
        likely = estimate_disturbances(fitter, fit, regression.linearised, start=noise, climb=False).noise
        processes = [*drifting_sensors(regression, likely, [at.location], base, needed)]
        processes += random_flows(regression, likely, [at.location], base)
        return max(processes, key=_gain, default=None)
    ascent = _Ascent(fitter, fit, noise, base)
    found = ascent.about(fit, at.explained, at.noise, at.location, at.frequency)
    return ascent.climbed(ascent.with_finer_positions(found), needed).localized(fitter)


class _Ascent:
    """Maximises the evidence of a discrepancy beside a fit: over its noise, its regressors, and the fit's parameters.

    fitter, noise: with the disturbance noise without the discrepancy. base: log evidence of the fit alone.
    """

    def __init__(self, fitter: Fitter, fit: Fit, noise: StateNoise, base: float) -> None:
        self.fitter, self.fit, self.noise, self.base = fitter, fit, noise, base
        self.largest, self.generator = largest_influence(fitter), torch.Generator().manual_seed(0)

    def evaluate(
        self, regression: DiscrepancyRegression, discrepancy: Discrepancy, place: str, noise: StateNoise
    ) -> _EvaluatedDiscrepancy:
        fit = regression.fit
        under = with_disturbances(self.fitter, fit, noise, discrepancy.linearised)
        whitened = WhitenedDiscrepancy(under, fit, discrepancy)
        regressed = whitened.sparse_fit(column_costs(discrepancy.choices, self.largest))
        without = log_likelihood(under, fit, discrepancy.linearised) + noise.log_prior() - self.base
        return _EvaluatedDiscrepancy(place, noise, under, regression, discrepancy, whitened, regressed, without)

    def about(
        self, fit: Fit, explained: Tensor, noise: StateNoise, place: str, frequency: float | None
    ) -> _EvaluatedDiscrepancy:
        """The discrepancy about a fit beside it, with the levels that are predicted from the readings of right sensors.

        explained: part of the readings (S, C) that the discrepancy explains.
        """
        data, right = self.fitter.data, Fitter(self.fitter.data, self.fitter.noise)
        if any(s.name == place for s in data.plant.sensors):
            right = Fitter(replace(data, readings=data.readings - explained), self.fitter.noise)
        along = with_disturbances(right, fit, self.noise) if self.fitter.whitening else right
        regression = DiscrepancyRegression(along, fit, frequency, STEPS)
        return self.evaluate(regression, regression.of(place), place, noise)

    def climbed(self, best: _EvaluatedDiscrepancy, needed: float) -> _EvaluatedDiscrepancy:
        """Noise, regressors and parameters of the fit in turn, until nothing gains or `needed` is out of reach."""
        for turn in range(MOST_TURNS):
            before, best = best, max(best, self._with_likely_noise(best, turn == 0), key=_gain)
            best = self.with_finer_positions(best)
            best = max(best, self._with_finer_frequency(best), key=_gain)
            if best.gain < SHARE * (needed - best.gain):
                break
            # An effect at the place keeps its parameters: the discrepancy is then the error of its law.
            if all(p.location != best.location for p in self.fit.candidate.placements):
                best = max(best, self._refitted(best), key=_gain)
            if best.gain - before.gain < max(CONVERGED, SHARE * (needed - best.gain)):
                break
        return best

    def with_finer_positions(self, known: _EvaluatedDiscrepancy) -> _EvaluatedDiscrepancy:
        """With further regressors under the same noise, until none is worth its selection.

        The estimated noise falls only after most of them were added, so that each alone seems to gain little.
        """
        at, used = known.discrepancy, known.regressed.used
        positions = Positions(known.regression, known.location, known.under, at, used, self.generator)
        while finer := positions.best(known.discrepancy, known.regressed.used):
            last = torch.arange(len(finer.choices)) == len(finer.choices) - 1
            further = self._changed(known, finer, last)
            if further.gain - known.gain < CONVERGED:
                break
            known = further
        return known

    def _with_finer_frequency(self, known: _EvaluatedDiscrepancy) -> _EvaluatedDiscrepancy:
        used, regression, at = known.regressed.used, known.regression, known.discrepancy
        finer = with_best_frequency(regression, known.location, known.under, regression.fit, at, used)
        return self._changed(known, finer, finer.sinusoids) if finer else known

    def _changed(
        self, known: _EvaluatedDiscrepancy, discrepancy: Discrepancy, columns: Tensor
    ) -> _EvaluatedDiscrepancy:
        """The same with a discrepancy that differs in some columns, (M,) bool."""
        whitened = known.whitened.with_columns(discrepancy.columns, columns)
        regressed = whitened.sparse_fit(column_costs(discrepancy.choices, self.largest))
        return replace(known, discrepancy=discrepancy, whitened=whitened, regressed=regressed)

    def _with_likely_noise(self, known: _EvaluatedDiscrepancy, climb: bool) -> _EvaluatedDiscrepancy:
        at, used = known.discrepancy, known.regressed.used
        further = LinearParameters(at.columns[..., used], torch.sqrt(known.regressed.precision[used]))
        fit = known.regression.fit
        likely = estimate_disturbances(self.fitter, fit, at.linearised, further, known.noise, climb).noise
        return self.evaluate(known.regression, at, known.location, likely)

    def _refitted(self, known: _EvaluatedDiscrepancy) -> _EvaluatedDiscrepancy:
        """The discrepancy with the parameters of the fit refitted beside it, and the levels predicted anew."""
        data, fit = self.fitter.data, known.regression.fit
        corrected = replace(data, readings=data.readings - known.explained)
        refitter = Fitter(corrected, self.fitter.noise, known.under.whitening)
        new = refitter.fit(Candidate(fit.candidate.placements, (fit.effect_values,)), fit)
        return self.about(new, known.explained, known.noise, known.location, known.discrepancy.frequency)


def _first_order_gains(
    regression: DiscrepancyRegression,
    starts: Sequence[StateNoise],
    fit: Fit,
    places: Sequence[str],
    base: float,
) -> dict[str, tuple[float, StateNoise]]:
    """Gain in log evidence of the best single regressor of each place, under the best of the noises, and that noise."""
    best: dict[str, tuple[float, StateNoise]] = {}
    for noise in starts:
        under = with_disturbances(regression.fitter, fit, noise, regression.linearised)
        offset = log_likelihood(under, fit, regression.linearised) + noise.log_prior() - base
        generator = torch.Generator().manual_seed(0)
        for place, gain in single_regressor_gains(regression, under, fit, places, generator).items():
            if place not in best or offset + gain > best[place][0]:
                best[place] = offset + gain, noise
    return best


def _evidence_bound(fitter: Fitter, fit: Fit, noise: StateNoise, choices: int) -> float:
    """Upper bound of the log evidence of a discrepancy in addition to a fit.

    It is that of one regressor that explains everything except sensor noise. A regressor that reduces chi-square by G
    costs (1 + log G) / 2 nats at its most likely precision, plus log(choices) for its selection.
    """
    undisturbed = with_disturbances(fitter, fit, replace(noise, intensity=torch.zeros_like(noise.intensity)))
    count, residual = int(fitter.data.mask.sum()), undisturbed.residual(fit.linearised.readings)
    cost = 0.5 * (1.0 + math.log(max(float(residual.square().sum()) - count, 1.0))) + math.log(choices)
    # The parameters are determined no better than with the disturbances.
    return (
        -0.5 * count
        - 0.5 * undisturbed.log_det
        - cost
        + occam(fitter, fit.space, fit.theta, fitter.whiten(fit.linearised.jacobian)[0])
    )


@dataclass(frozen=True)
class _EvaluatedDiscrepancy:
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
    def fitness(self) -> float:
        return self.without + self.regressed.reduction - float(self.regressed.used.sum())

    @property
    def explained(self) -> Tensor:
        """The part of the readings (S, C) that the discrepancy explains."""
        return self.discrepancy.columns @ self.regressed.mean

    def localized(self, fitter: Fitter) -> LocalizedDiscrepancy:
        """The result. fitter: that of the explanation, under its sensor noise alone."""
        explained, at = self.explained, self.discrepancy
        size = float(torch.linalg.vector_norm(fitter.noise.whiten(explained, fitter.data.mask)))
        return LocalizedDiscrepancy(
            self.location, self.gain, self.fitness, explained, size, at.frequency, self.regression.fit, self.noise
        )


def _gain(discrepancy: _EvaluatedDiscrepancy | LocalizedDiscrepancy) -> float:
    return discrepancy.gain
