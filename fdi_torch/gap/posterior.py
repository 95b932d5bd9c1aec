"""Posterior over hypotheses: a set of effects, with or without an unknown discrepancy at one place.

    log weight(S)    = log evidence of S + log prior of its random flows
    log weight(S, p) = log weight(S) + gain of a free discrepancy at p + log odds of an unknown there

each under its most likely disturbance noise (`marginal_likelihood.py`, `localization/localize.py`). No library
has the exact law of a rig (Brynjarsdottir and O'Hagan, 2014). A discrepancy at a place where S has an effect,
and small compared with it, is therefore attributed to the effect, and its weight goes to S. A large one means that the
law there is a different one: then the effects at that place are part of the unknown.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

from fdi_torch.estimate.evidence import ODDS, RARE, posterior
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.library import canonical, tanks_of
from fdi_torch.gap.localization.localize import FitBeside, localize
from fdi_torch.gap.localization.localized_discrepancy import LocalizedDiscrepancy
from fdi_torch.gap.marginal_likelihood import log_prior, with_disturbances
from fdi_torch.gap.screening import Option
from fdi_torch.gap.structure_search import ExplanationPool, RankedExplanation, SearchResult
from fdi_torch.plant.description import PlantDescription


@dataclass(frozen=True)
class CauseHypothesis:
    """An explanation with or without an unknown discrepancy.

    causes: effects of the explanation, without those that the unknown replaces. weight: log posterior, not normalised.
    """

    explanation: RankedExplanation
    causes: tuple[CauseName, ...]
    weight: float
    place: LocalizedDiscrepancy | None = None

    @property
    def unknown_at(self) -> str | None:
        return self.place.location if self.place else None

    @property
    def fit(self) -> Fit:
        return self.place.fit if self.place else self.explanation.fit


@dataclass(frozen=True)
class Posterior:
    """hypotheses: the likeliest first, with their probabilities. unexamined: probability of all that was not fitted.
    places: marginal probability of a cause at each place, the likeliest first."""

    hypotheses: tuple[CauseHypothesis, ...]
    probabilities: tuple[float, ...]
    unexamined: float
    places: tuple[tuple[str, float], ...]

    @property
    def best(self) -> CauseHypothesis:
        return self.hypotheses[0]

    def credible_set(self, level: float) -> tuple[CauseHypothesis, ...]:
        """The smallest set of hypotheses with this share of the examined probability."""
        total, hypotheses = 0.0, []
        for hypothesis, probability in zip(self.hypotheses, self.probabilities, strict=True):
            hypotheses.append(hypothesis)
            total += probability
            if total >= level * (1.0 - self.unexamined):
                break
        return tuple(hypotheses)


def posterior_of(
    pool: ExplanationPool,
    result: SearchResult,
    options: Sequence[Option],
    plant: PlantDescription,
    places: Sequence[str],
    named_only: bool,
) -> Posterior:
    """Posterior over the explanations of a search, with and without an unknown discrepancy at each place.

    pool: pool of the evaluated explanations, which may grow. options: effects that are fitted before something at their
    place is called unknown. named_only: without unknown discrepancies.
    """

    def weight(explanation: RankedExplanation) -> float:
        return explanation.log_evidence if named_only else explanation.log_weight

    hypotheses = [CauseHypothesis(e, causes_in_order(e.fit), weight(e)) for e in result.explanations]
    if not named_only:
        likeliest = _likeliest(hypotheses).explanation
        for explanation in {e.key: e for e in (likeliest, result.best, result.null)}.values():
            hypotheses += _with_unknowns(pool, explanation, places, len(places), _likeliest(hypotheses))
        hypotheses += _with_fewer_effects(pool, _likeliest(hypotheses), len(places))
        hypotheses = _after_fits_at_unknowns(pool, hypotheses, options, len(places))
        hypotheses += _with_more_effects(pool, _likeliest(hypotheses), options, len(places))
        hypotheses += _from_unknown_alone(pool, result.null, _likeliest(hypotheses), options, len(places))
        least = _likeliest(hypotheses).weight + math.log(RARE)
        hypotheses += [
            _about_predicted_levels(h.explanation) for h in hypotheses if h.place is None and h.weight > least
        ]
        hypotheses += [law for h in hypotheses if h.weight > least for law in _with_inexact_laws(pool, h, options)]
    best: dict[tuple[frozenset[CauseName], str | None], CauseHypothesis] = {}
    for h in hypotheses:
        key = frozenset(canonical(c, plant) for c in h.causes), h.unknown_at
        if key not in best or h.weight > best[key].weight:
            best[key] = h
    ranked = sorted(best.values(), key=lambda h: -h.weight)
    unfitted = weight(result.best) + math.log(max(result.unexamined, 1e-300))
    *probabilities, unexamined = posterior([*(h.weight for h in ranked), unfitted])
    return Posterior(tuple(ranked), tuple(probabilities), unexamined, _marginals(ranked, probabilities, places))


def _likeliest(hypotheses: Sequence[CauseHypothesis]) -> CauseHypothesis:
    return max(hypotheses, key=lambda h: h.weight)


def _after_fits_at_unknowns(
    pool: ExplanationPool, hypotheses: Sequence[CauseHypothesis], options: Sequence[Option], places: int
) -> list[CauseHypothesis]:
    """The hypotheses after the effects of the library were fitted at the place of each unknown that is relevant.

    An unknown is a law that no library has: its weight goes to effects at the same place that predict as well by
    Akaike's criterion. The law of such an effect may also be inexact.
    """
    best, before = _likeliest(hypotheses), set(pool.explanations)
    inexact: list[CauseHypothesis] = []
    for h in hypotheses:
        if h.place and h.weight > best.weight + math.log(RARE):
            under = with_disturbances(h.explanation.fitter, h.fit, replace(h.place.noise, wander=None))
            pool.extend_at(h.explanation, h.place.location, under, options)
            here = [e for e in list(pool.explanations.values()) if _added_at(h.place.location, e, h.explanation)]
            inexact += [law for e in here for law in _with_unknowns(pool, e, [h.place.location], places, best)]
    added = [e for key, e in pool.explanations.items() if key not in before]
    named = [CauseHypothesis(e, causes_in_order(e.fit), e.log_weight) for e in added]
    return [*named, *inexact, *(_as_known(h, pool.explanations.values()) for h in hypotheses)]


def _added_at(place: str, known: RankedExplanation, alone: RankedExplanation) -> bool:
    """Whether an explanation has all effects of another one, and further ones at one place only."""
    return known.key > alone.key and {at for _, at in known.key - alone.key} == {place}


def _as_known(h: CauseHypothesis, explanations: Iterable[RankedExplanation]) -> CauseHypothesis:
    """The hypothesis, or that of effects at the place of its unknown which predict as well."""
    if h.place is None:
        return h
    for known in explanations:
        at_place = _added_at(h.place.location, known, h.explanation)
        if at_place and _fitness(known, h.explanation) >= h.place.fitness:
            return CauseHypothesis(known, causes_in_order(known.fit), h.weight)
    return h


def _about_predicted_levels(explanation: RankedExplanation) -> CauseHypothesis:
    """An explanation linearised where discrepancies are, so that their gains do not contain that of another point."""
    gain = localize(explanation.fitter, explanation.fit, explanation.noise, (), math.inf).itself
    return CauseHypothesis(explanation, causes_in_order(explanation.fit), explanation.log_weight + gain)


def _with_unknowns(
    pool: ExplanationPool,
    explanation: RankedExplanation,
    at: Sequence[str],
    places: int,
    best: CauseHypothesis | None = None,
    beside: FitBeside | None = None,
) -> list[CauseHypothesis]:
    """An explanation with an unknown discrepancy at each of some places, as far as relevant against the best."""
    odds = math.log(ODDS.unknown / places)
    needed = best.weight + math.log(RARE) - explanation.log_weight - odds if best else -math.inf
    found = localize(explanation.fitter, explanation.fit, explanation.noise, at, needed, beside)
    itself = CauseHypothesis(explanation, causes_in_order(explanation.fit), explanation.log_weight + found.itself)
    return [itself, *(_with_unknown(pool, explanation, d, places) for d in found.discrepancies)]


def _with_unknown(
    pool: ExplanationPool, explanation: RankedExplanation, place: LocalizedDiscrepancy, places: int
) -> CauseHypothesis:
    """An explanation with a discrepancy at one place, which is attributed to an effect there if it is small."""
    causes = causes_in_order(explanation.fit)
    # A random flow into a tank may stand for the error of any flow there.
    plant, flow = pool.fitter.data.plant, place.noise.apart is not None
    here = [c for c in causes if c[1] == place.location or (flow and place.location in tanks_of(c[1], plant))]
    weight = explanation.log_weight + place.gain
    if here and _is_small(pool, explanation, place.size, here):
        return CauseHypothesis(explanation, causes, weight)
    weight += math.log(ODDS.unknown / places)
    return CauseHypothesis(explanation, tuple(c for c in causes if c not in here), weight, place)


def _fitness(known: RankedExplanation, alone: RankedExplanation) -> float:
    """Log likelihood of an explanation less one nat for each parameter (Akaike, 1974), over that of a smaller one."""

    def likelihood(e: RankedExplanation) -> float:
        return -0.5 * e.fit.cost - 0.5 * e.fitter.log_det + e.noise.log_prior() - len(e.fit.space)

    return likelihood(known) - likelihood(alone)


def _is_small(pool: ExplanationPool, explanation: RankedExplanation, size: float, here: Collection[CauseName]) -> bool:
    """Whether a discrepancy of this size is small compared with the influence of the effects `here`, at its place."""
    elsewhere = explanation.key - set(here)
    least = min(_cost(pool.fitter, e.fit) for e in pool.explanations.values() if e.key <= elsewhere)
    return size < ODDS.discrepancy * math.sqrt(max(least - _cost(pool.fitter, explanation.fit), 0.0))


def _cost(fitter: Fitter, fit: Fit) -> float:
    return float(fitter.residual(fit.linearised.readings).square().sum())


def _with_inexact_laws(pool: ExplanationPool, h: CauseHypothesis, options: Sequence[Option]) -> list[CauseHypothesis]:
    """The hypothesis without effects that are small compared with others at their place.

    Such an effect describes the error of the other's law. It costs its selection among all effects there instead of the
    prior odds of one more cause.
    """
    explained: list[CauseHypothesis] = []
    for cause in h.causes:
        others = {c for c in h.causes if c[1] == cause[1]} - {cause}
        if not others:
            continue
        reduced = pool.without(h.explanation, cause)
        size = math.sqrt(max(_cost(pool.fitter, reduced.fit) - _cost(pool.fitter, h.explanation.fit), 0.0))
        if _is_small(pool, h.explanation, size, others | {cause}):
            odds = log_prior(reduced.key, pool.choices) - log_prior(h.explanation.key, pool.choices)
            weight = h.weight + odds - math.log(len({o.cause for o in options if o.cause[1] == cause[1]}))
            law = CauseHypothesis(reduced, tuple(c for c in h.causes if c != cause), weight, h.place)
            explained += [law, *_with_inexact_laws(pool, law, options)]
    return explained


def _with_fewer_effects(pool: ExplanationPool, best: CauseHypothesis, places: int) -> list[CauseHypothesis]:
    """Hypotheses with fewer effects: an effect may only have compensated the unknown, or a wrong law of another."""
    accepted: list[CauseHypothesis] = []
    while len(best.fit.key) > (0 if best.place else 1):
        trials = []
        for cause in best.fit.key:
            reduced = pool.without(best.explanation, cause)
            at = [best.place.location] if best.place else list(dict.fromkeys(place for _, place in reduced.key))
            trials += _with_unknowns(pool, reduced, at, places, best)
        accepted += trials
        if not trials or _likeliest(trials).weight <= best.weight:
            break
        best = _likeliest(trials)
    return accepted


def _with_more_effects(
    pool: ExplanationPool, best: CauseHypothesis, options: Sequence[Option], places: int
) -> list[CauseHypothesis]:
    """Hypotheses with further effects beside the unknown of the best one, which hid them."""
    accepted: list[CauseHypothesis] = []
    while best.place:
        under = with_disturbances(best.explanation.fitter, best.fit, best.place.noise)
        explained, noise, at = best.place.explained, best.place.noise, [best.place.location]
        trials = [
            h
            for extension, fit in pool.extend_beside(best.explanation, explained, under, options)
            for h in _with_unknowns(pool, extension, at, places, best, FitBeside(fit, explained, noise))
        ]
        accepted += trials
        if not trials or _likeliest(trials).weight <= best.weight:
            break
        best = _likeliest(trials)
    return accepted


def _from_unknown_alone(
    pool: ExplanationPool,
    null: RankedExplanation,
    best: CauseHypothesis,
    options: Sequence[Option],
    places: int,
) -> list[CauseHypothesis]:
    """Hypotheses with effects beside the unknown of the best one, without those that were found before the unknown."""
    if best.place is None or not best.explanation.key:
        return []
    alone = [h for h in _with_unknowns(pool, null, [best.place.location], places) if h.place]
    return [further for h in alone for further in (h, *_with_more_effects(pool, h, options, places))]


def _marginals(
    ranked: Iterable[CauseHypothesis], probabilities: Iterable[float], places: Sequence[str]
) -> tuple[tuple[str, float], ...]:
    """Marginal probability of a cause at each place, the likeliest first."""
    share = dict.fromkeys(places, 0.0)
    for h, probability in zip(ranked, probabilities, strict=True):
        for at in {place for _, place in h.causes} | ({h.unknown_at} if h.unknown_at else set()):
            share[at] = share.get(at, 0.0) + probability
    return tuple(sorted(share.items(), key=lambda item: -item[1]))


def causes_in_order(fit: Fit) -> tuple[CauseName, ...]:
    """The causes of a fit in the order of its placements."""
    return tuple((p.effect.name, p.location) for p in fit.candidate.placements)
