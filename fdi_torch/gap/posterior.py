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

import torch

from fdi_torch.estimate.evidence import ODDS, RARE, posterior
from fdi_torch.estimate.kalman import StateNoise
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.explanation_pool import ExplanationPool, RankedExplanation
from fdi_torch.gap.library import canonical, tanks_of
from fdi_torch.gap.localization.localize import FitBeside, localize
from fdi_torch.gap.localization.localized_discrepancy import LocalizedDiscrepancy
from fdi_torch.gap.marginal_likelihood import log_prior, with_disturbances
from fdi_torch.gap.screening import Option
from fdi_torch.gap.start_choice import vector_of
from fdi_torch.gap.structure_search import SearchResult
from fdi_torch.plant.description import PlantDescription


@dataclass(frozen=True)
class CauseHypothesis:
    """An explanation with or without a discrepancy at one place.

    causes: effects of the explanation, without those that an unknown replaces. weight: log posterior, not normalised.
    discrepancy: an unknown, or the error of the law of an effect at the same place. inexact: whether it is the latter.
    """

    explanation: RankedExplanation
    causes: tuple[CauseName, ...]
    weight: float
    discrepancy: LocalizedDiscrepancy | None = None
    inexact: bool = False

    @property
    def place(self) -> LocalizedDiscrepancy | None:
        """The discrepancy, if it is an unknown."""
        return None if self.inexact else self.discrepancy

    @property
    def unknown_at(self) -> str | None:
        return self.place.location if self.place else None

    @property
    def noise(self) -> StateNoise:
        return self.discrepancy.noise if self.discrepancy else self.explanation.noise

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

    hypotheses = [_about_predicted_levels(e) for e in result.explanations]
    best_named = hypotheses[0].weight
    if not named_only:
        for explanation in {e.key: e for e in (_likeliest(hypotheses).explanation, result.null)}.values():
            hypotheses += _with_unknowns(pool, explanation, places, len(places), _likeliest(hypotheses))
        hypotheses = _after_fits_at_unknowns(pool, hypotheses, options, len(places))
        further = _climbed(pool, _likeliest(hypotheses), options, len(places))
        best = _likeliest([*hypotheses, *further])
        if best.discrepancy and any(at != best.discrepancy.location for _, at in best.explanation.key):
            alone = _with_unknowns(pool, result.null, [best.discrepancy.location], len(places))
            further += [*alone, *_climbed(pool, _likeliest(alone), options, len(places))]
        hypotheses += _after_fits_at_unknowns(pool, further, options, len(places), _likeliest(hypotheses).weight)
        least = _likeliest(hypotheses).weight + math.log(RARE)
        hypotheses += [law for h in hypotheses if h.weight > least for law in _with_inexact_laws(pool, h, options)]
    by_causes: dict[tuple[frozenset[CauseName], str | None], CauseHypothesis] = {}
    for h in sorted(hypotheses, key=lambda h: -h.weight):
        by_causes.setdefault((frozenset(canonical(c, plant) for c in h.causes), h.unknown_at), h)
    ranked = list(by_causes.values())
    unfitted = best_named + math.log(max(result.unexamined, 1e-300))
    *probabilities, unexamined = posterior([*(h.weight for h in ranked), unfitted])
    return Posterior(tuple(ranked), tuple(probabilities), unexamined, _marginals(ranked, probabilities, places))


def _likeliest(hypotheses: Sequence[CauseHypothesis]) -> CauseHypothesis:
    return max(hypotheses, key=lambda h: h.weight)


def _after_fits_at_unknowns(
    pool: ExplanationPool,
    hypotheses: Sequence[CauseHypothesis],
    options: Sequence[Option],
    places: int,
    rival: float = -math.inf,
) -> list[CauseHypothesis]:
    """The hypotheses after the effects of the library were fitted at the place of each unknown that is relevant.

    An unknown is a law that no library has: its weight goes to effects at the same place that predict as well by
    Akaike's criterion. The law of such an effect may also be inexact. rival: weight of the likeliest of all others.
    """
    added: list[CauseHypothesis] = []
    best = max((h.weight for h in hypotheses), default=rival)
    for h in hypotheses:
        if h.place and h.weight > max(best, rival) + math.log(RARE):
            under = with_disturbances(h.explanation.fitter, h.fit, replace(h.place.noise, wander=None))
            at_place = [o for o in options if o.placement.location == h.place.location]
            pool.extend_under(under, h.explanation, at_place)
            here = [e for e in list(pool.explanations.values()) if _added_at(h.place.location, e, h.explanation)]
            added += [law for e in here for law in _with_unknowns(pool, e, [h.place.location], places, h)]
    return [*added, *(_as_known(h, pool.explanations.values()) for h in hypotheses)]


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
    rival = best.noise if best else None
    found = localize(explanation.fitter, explanation.fit, explanation.noise, at, needed, rival, beside)
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
    if here and place.size < ODDS.discrepancy * _influence(pool.fitter, explanation.fit, here):
        return CauseHypothesis(explanation, causes, weight, place, inexact=True)
    weight += math.log(ODDS.unknown / places)
    return CauseHypothesis(explanation, tuple(c for c in causes if c not in here), weight, place)


def _fitness(known: RankedExplanation, alone: RankedExplanation) -> float:
    """Log likelihood of an explanation less one nat for each parameter (Akaike, 1974), over that of a smaller one."""

    def likelihood(e: RankedExplanation) -> float:
        return -0.5 * e.fit.cost - 0.5 * e.fitter.log_det + e.noise.log_prior() - len(e.fit.space)

    return likelihood(known) - likelihood(alone)


def _influence(fitter: Fitter, fit: Fit, causes: Collection[CauseName]) -> float:
    """Norm of the influence of some of a fit's effects on the readings, in units of the sensor noise.

    To first order without the part that the other parameters, within their tolerances, would have in common with it.
    """
    others = [p for p in fit.candidate.placements if (p.effect.name, p.location) not in causes]
    engine = fitter.engine(Candidate(tuple(others)), list(fit.values_of(others)))
    theta = vector_of(engine.space, fit.values)
    without = engine.converge(theta.unsqueeze(0), fit.linearised.levels[..., : len(fitter.data.plant.tanks)])
    scale, pull, _ = fitter.priors(engine.space, theta)
    change = fitter.noise.whiten(fit.linearised.readings[0] - without.readings[0], fitter.data.mask).flatten()
    jacobian = (fitter.noise.whiten(without.jacobian[0], fitter.data.mask) * scale).flatten(0, 1)
    rows = torch.cat([jacobian, torch.diag(pull)])
    target = torch.cat([change, torch.zeros_like(pull)])
    return float(torch.linalg.vector_norm(target - rows @ torch.linalg.lstsq(rows, target.unsqueeze(1)).solution[:, 0]))


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
        own, all_here = (_influence(pool.fitter, h.explanation.fit, which) for which in ({cause}, {cause} | others))
        if own < ODDS.discrepancy * all_here:
            reduced = pool.without(h.explanation, cause)
            odds = log_prior(reduced.key, pool.choices) - log_prior(h.explanation.key, pool.choices)
            weight = h.weight + odds - math.log(len({o.cause for o in options if o.cause[1] == cause[1]}))
            law = CauseHypothesis(reduced, tuple(c for c in h.causes if c != cause), weight, h.discrepancy, h.inexact)
            explained += [law, *_with_inexact_laws(pool, law, options)]
    return explained


def _climbed(
    pool: ExplanationPool, best: CauseHypothesis, options: Sequence[Option], places: int
) -> list[CauseHypothesis]:
    """Hypotheses about one: with an effect fewer, or with a further one beside its discrepancy, while that improves it.

    An effect may only have compensated a discrepancy, which may also have hidden an effect.
    """
    found: list[CauseHypothesis] = []
    while True:
        trials = [*_with_fewer_effects(pool, best, places), *_with_more_effects(pool, best, options, places)]
        found += trials
        if not trials or _likeliest(trials).weight <= best.weight:
            return found
        best = _likeliest(trials)


def _with_fewer_effects(pool: ExplanationPool, best: CauseHypothesis, places: int) -> list[CauseHypothesis]:
    """The hypothesis without each of its effects, with its discrepancy, or one at the place of another effect."""
    trials: list[CauseHypothesis] = []
    for cause in best.explanation.key if best.discrepancy or len(best.explanation.key) > 1 else ():
        reduced = pool.without(best.explanation, cause)
        at = [best.discrepancy.location] if best.discrepancy else list(dict.fromkeys(at for _, at in reduced.key))
        trials += _with_unknowns(pool, reduced, at, places, best)
    return trials


def _with_more_effects(
    pool: ExplanationPool, best: CauseHypothesis, options: Sequence[Option], places: int
) -> list[CauseHypothesis]:
    """The hypothesis with each of the most promising further effects beside its discrepancy."""
    if (at := best.discrepancy) is None:
        return []
    under = with_disturbances(best.explanation.fitter, at.fit, at.noise)
    corrected = replace(under.data, readings=under.data.readings - at.explained)
    extensions = pool.extend_under(Fitter(corrected, under.noise, under.whitening), best.explanation, options)
    return [
        h
        for extension, fit in extensions
        for h in _with_unknowns(pool, extension, [at.location], places, best, FitBeside(fit, at.explained, at.noise))
    ]


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
