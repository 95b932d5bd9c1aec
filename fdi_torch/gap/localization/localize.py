"""Ranking of the places of a discrepancy by evidence, whatever the law of the discrepancy.

A discrepancy is a linear combination of a few regressors of the component's own variables (`regressors.py`), about the
predicted trajectory. The log evidence is that of a sparse regression (`sparse_regression.py`), with each regressor
selected among all of the component, under the disturbance noise that is most likely with the discrepancy (as for named
effects: `marginal_likelihood.py`). Random processes at one tank or sensor compete with these (`random_processes.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import torch

from fdi_torch.estimate.evidence import RARE, TOLERANCE
from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_ascent import DiscrepancyAscent, gain_of
from fdi_torch.gap.localization.discrepancy_regression import DiscrepancyRegression
from fdi_torch.gap.localization.fine_positions import FREQUENCY_ERROR
from fdi_torch.gap.localization.localized_discrepancy import (
    LocalizedDiscrepancy,
    is_rounding_error,
    log_evidence,
    log_likelihood,
    nearly_without_disturbances,
)
from fdi_torch.gap.localization.predicted_levels import LevelFilter, measured_filter
from fdi_torch.gap.localization.random_processes import drifting_sensors, random_flows
from fdi_torch.gap.localization.regressors import likely_frequencies, step_functions
from fdi_torch.gap.localization.single_regressor_gain import SingleRegressorGains
from fdi_torch.gap.marginal_likelihood import estimate_disturbances, occam, with_disturbances

CALIBRATED = 3  # evaluations after which a gain that was estimated is trusted to be no further too low than theirs


@dataclass
class Shortfall:
    """By how much first-order gains were too low in all localizations of a search, relative to the gains of the
    regressors alone: the largest ratio at the places `examined`."""

    largest: float = -math.inf
    examined: int = 0

    def note(self, gain: float, expected: float, alone: float) -> None:
        """A place of which `gain` was found where `expected` is the first-order gain, `alone` that of its regressor."""
        self.largest, self.examined = max(self.largest, (gain - expected) / max(alone, 1.0)), self.examined + 1

    def excludes(self, expected: float, alone: float, needed: float) -> bool:
        """Whether a place cannot gain `needed`, if its first-order gain is no further too low than others were."""
        return self.examined >= CALIBRATED and expected + self.largest * alone < needed


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
    *,
    needed: float = -math.inf,
    rival: StateNoise | None = None,
    log_odds: float = 0.0,
    earlier: Shortfall | None = None,
    step: Callable[[], None] = lambda: None,
) -> Localization:
    """Evaluate a discrepancy at each of the places. One that selects no regressor is not in the result.

    fitter: with the disturbance noise of the fit. needed: gain in log evidence below which a discrepancy is irrelevant;
    there are none in the result if none can reach it. rival: the noise that a likelier hypothesis left. log_odds: prior
    log odds of a discrepancy at one place against none. earlier: in other localizations of the same recordings; these
    here are added. step: called when a place has been examined.
    """
    base = log_likelihood(fitter, fit, fit.linearised) + noise.log_prior()
    scale = torch.minimum(noise.scale, rival.scale) if rival else noise.scale
    hopeless = _perfect_evidence(fitter, fit, replace(noise, scale=scale)) - base < needed
    if hopeless and not places:
        return Localization((), 0.0)
    data, white = fitter.data, fitter.residual(fit.linearised.readings)[0]
    frequencies = likely_frequencies(white, data.rows, data.row_spacing, data.longest_duration)
    evidence, likely, regression = _about_predicted(fitter, fit, noise, base, frequencies)
    if not math.isfinite(base + evidence):
        return Localization((), 0.0)
    itself = max(evidence - base, 0.0)
    if not places:
        return Localization((), itself)
    ascent = DiscrepancyAscent(fitter, regression.level_filter, base)
    noises = likely, nearly_without_disturbances(likely)
    first_order = _first_order_gains(regression, noises, places, base)
    if hopeless and all(expected < needed for expected, _ in first_order.values()):
        return Localization((), itself)
    evaluated: dict[str, LocalizedDiscrepancy] = {}
    earlier, here = earlier or Shortfall(), Shortfall()
    for place, (expected, alone) in sorted(first_order.items(), key=lambda item: -item[1][0]):
        if any(shortfall.excludes(expected, alone, needed) for shortfall in (earlier, here)):
            continue
        best = ascent.climbed(ascent.with_decreasing_noise(regression, place, likely), needed)
        step()
        for shortfall in (earlier, here):
            shortfall.note(best.gain, expected, alone)
        selected = bool(best.regressed.used.any())
        itself = max(itself, best.without if best.regression is regression or not selected else -math.inf)
        needed = max(needed, itself - log_odds + math.log(RARE))
        largest = float(best.explained.square().mean(dim=0).max().sqrt())
        if selected and not is_rounding_error(fitter, place, largest):
            needed, evaluated[place] = max(needed, best.gain + math.log(RARE)), best.localized(fitter)
    if others := _without_the_period(evaluated.values(), data.longest_duration):
        period = max(evaluated.values(), key=gain_of).periods[0]
        periodic = DiscrepancyRegression(fitter, fit, [1.0 / period], regression.level_filter)
    for at in others:
        again = ascent.climbed(ascent.with_decreasing_noise(periodic, at.location, likely), needed)
        evaluated[at.location] = max(at, again.localized(fitter), key=gain_of)
    processes = [*drifting_sensors(regression, likely, places, base, needed)]
    processes += random_flows(regression, likely, places, base, needed)
    return Localization(_likeliest_of_each_place([*evaluated.values(), *processes]), itself)


def _about_predicted(
    fitter: Fitter, fit: Fit, noise: StateNoise, base: float, frequencies: Sequence[float]
) -> tuple[float, StateNoise, DiscrepancyRegression]:
    """The log evidence of a fit about predicted levels, with the most likely noise, and the regression there.

    The evidence of a linear plant does not depend on the levels about which it is linearised. If the evidence about the
    predicted levels differs from that about the fit, levels are also predicted by a filter that is linearised about the
    measured ones, and the likelier prediction is used.
    """
    about_each = []
    for measured in (False, True):
        level_filter = measured_filter(fitter, fit, noise) if measured else LevelFilter(noise)
        regression = DiscrepancyRegression(fitter, fit, frequencies, level_filter)
        linearised, likely = regression.linearised, level_filter.noise
        evidence = log_evidence(fitter, fit, likely, linearised)
        is_linear = abs(evidence - base) < TOLERANCE
        if math.isfinite(evidence):
            likely = estimate_disturbances(fitter, fit, linearised, start=likely, climb=False).noise
            evidence = log_evidence(fitter, fit, likely, linearised)
        about_each.append((evidence, likely, regression))
        if is_linear:
            break
    return max(about_each, key=itemgetter(0))


def _without_the_period(discrepancies: Collection[LocalizedDiscrepancy], duration: float) -> list[LocalizedDiscrepancy]:
    """The discrepancies without the period of the likeliest one, if that has a period.

    The search at each place begins at frequencies of a spectrum, and may end at a harmonic. duration: of the longest
    recording, s.
    """
    best = max(discrepancies, key=gain_of, default=None)
    if best is None or not best.periods:
        return []
    frequency, error = 1.0 / best.periods[0], FREQUENCY_ERROR / duration
    return [d for d in discrepancies if all(abs(1.0 / p - frequency) > error for p in d.periods[:1])]


def _likeliest_of_each_place(discrepancies: Sequence[LocalizedDiscrepancy]) -> tuple[LocalizedDiscrepancy, ...]:
    """The discrepancy with the largest gain at each place, the likeliest place first."""
    best: dict[str, LocalizedDiscrepancy] = {}
    for discrepancy in sorted(discrepancies, key=gain_of, reverse=True):
        best.setdefault(discrepancy.location, discrepancy)
    return tuple(best.values())


def localize_beside(
    fitter: Fitter, fit: Fit, noise: StateNoise, at: LocalizedDiscrepancy, needed: float = -math.inf
) -> LocalizedDiscrepancy | None:
    """The discrepancy `at` of an explanation beside another one; None if there is none.

    fitter, noise: with the disturbance noise without the discrepancy. fit: of the readings without what the discrepancy
    explains of them. needed: gain in log evidence below which it is irrelevant.
    """
    base = log_likelihood(fitter, fit, fit.linearised) + noise.log_prior()
    if at.selection is None:
        regression = DiscrepancyRegression(fitter, fit, (), LevelFilter(noise))
        likely = estimate_disturbances(fitter, fit, regression.linearised, start=noise, climb=False).noise
        processes = [*drifting_sensors(regression, likely, [at.location], base, needed)]
        processes += random_flows(regression, likely, [at.location], base, needed)
        return max(processes, key=gain_of, default=None)
    ascent = DiscrepancyAscent(fitter, at.level_filter, base)
    first = ascent.about(fit, at.explained, at.noise, at.location, at.selection)
    return ascent.climbed(ascent.with_finer_positions(first), needed).localized(fitter)


def _first_order_gains(
    regression: DiscrepancyRegression, noises: Sequence[StateNoise], places: Sequence[str], base: float
) -> dict[str, tuple[float, float]]:
    """First-order gain in log evidence of the best single regressor of each place under the best of the noises, with
    that of the noise; and the gain of the regressor alone, without the cost of its selection."""
    fit, linearised, fitter = regression.fit, regression.linearised, regression.fitter
    under = [with_disturbances(fitter, fit, noise, linearised) for noise in noises]
    without = [
        log_likelihood(each, fit, linearised, bounded=False) + noise.log_prior() - base
        for each, noise in zip(under, noises, strict=True)
    ]
    gains, first_order = SingleRegressorGains(regression, under, torch.Generator().manual_seed(0)), {}
    for place in places:  # the regression keeps the regressors of one place only
        each = zip(without, gains.at(place), strict=True)
        first_order[place] = max(((w + g.net, g.gain) for w, g in each), key=itemgetter(0))
    return first_order


def _perfect_evidence(fitter: Fitter, fit: Fit, noise: StateNoise) -> float:
    """Log evidence of a single regressor that explains everything except sensor noise, in addition to a fit.

    No discrepancy has more evidence under sensor noise of this size, but one that varies as fast as the noise has
    enlarged its estimate. A regressor that reduces chi-square by G costs (1 + log G) / 2 nats at its most likely
    precision, plus the logarithm of the number of steps in time for its selection.
    """
    undisturbed = with_disturbances(fitter, fit, replace(noise, intensity=torch.zeros_like(noise.intensity)))
    count, residual = int(fitter.data.mask.sum()), undisturbed.residual(fit.linearised.readings)
    steps = step_functions(len(fitter.data.readings), len(fitter.data.parts))
    cost = 0.5 * (1.0 + math.log(max(float(residual.square().sum()) - count, 1.0))) + math.log(steps)
    # The parameters are determined no better than with the disturbances.
    return (
        -0.5 * count
        - 0.5 * undisturbed.log_det
        - cost
        + occam(fitter, fit.space, fit.theta, fitter.whiten(fit.linearised.jacobian)[0])
    )
