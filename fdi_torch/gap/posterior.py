"""The posterior over explanations: sets of effects, with something unknown at one place beside them or nowhere.

    log weight(S)    = log evidence of S
    log weight(S, p) = log evidence of S + what a free discrepancy at p gains beside it + log odds of an unknown there

each under the noise that is most likely beside it (gap/evidence.py, gap/where/localization.py). No library has the
exact law of anything (Brynjarsdottir and O'Hagan, 2014): a discrepancy at a place where S has an effect, and small
beside what that effect does, belongs to the effect, and its weight goes to S. A large one means that the law there is
another one: then the effects at that place are part of the unknown.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fdi_torch.estimate.evidence import ODDS, RARE, posterior
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.library import canonical
from fdi_torch.gap.localization.localize import LocalizedDiscrepancy, localize
from fdi_torch.gap.search import ExplanationPool, RankedExplanation, SearchResult
from fdi_torch.plant.description import PlantDescription


@dataclass(frozen=True)
class CauseHypothesis:
    """An explanation with an unknown discrepancy beside it, or without. causes: as the fit places them, without those
    that the unknown replaces. weight: log of the posterior, not normalised.
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
        return self.explanation.fit


@dataclass(frozen=True)
class Posterior:
    """hypotheses: the likeliest first, with their probabilities. unexamined: the share of what was never fitted.
    places: marginal probability that something is wrong there, the likeliest first.
    """

    hypotheses: tuple[CauseHypothesis, ...]
    probabilities: tuple[float, ...]
    unexamined: float
    places: tuple[tuple[str, float], ...]

    @property
    def best(self) -> CauseHypothesis:
        return self.hypotheses[0]

    def content(self, level: float) -> tuple[CauseHypothesis, ...]:
        """The fewest hypotheses that hold so much together of what was examined."""
        held, kept = 0.0, []
        for hypothesis, probability in zip(self.hypotheses, self.probabilities, strict=True):
            kept.append(hypothesis)
            held += probability
            if held >= level * (1.0 - self.unexamined):
                break
        return tuple(kept)


def weighed(
    judged: ExplanationPool, found: SearchResult, plant: PlantDescription, places: Sequence[str], named_only: bool
) -> Posterior:
    """judged: what the search has judged, which may grow. named_only: without any unknown."""
    hypotheses = [CauseHypothesis(e, causes_in_order(e.fit), e.log_evidence) for e in found.explanations]
    if not named_only:
        for explanation in {e.key: e for e in (found.best, found.null)}.values():
            hypotheses += _beside(judged, found, explanation, places, len(places), _best(hypotheses))
        hypotheses += _pruned(judged, found, _best(hypotheses), len(places))
    best: dict[tuple[frozenset[CauseName], str | None], CauseHypothesis] = {}
    for h in hypotheses:
        key = frozenset(canonical(c, plant) for c in h.causes), h.unknown_at
        if key not in best or h.weight > best[key].weight:
            best[key] = h
    ranked = sorted(best.values(), key=lambda h: -h.weight)
    weights = [h.weight for h in ranked]
    *probabilities, unexamined = posterior(
        [*weights, found.best.log_evidence + math.log(max(found.unexamined, 1e-300))]
    )
    return Posterior(tuple(ranked), tuple(probabilities), unexamined, _guilty(ranked, probabilities, places))


def _best(hypotheses: Sequence[CauseHypothesis]) -> CauseHypothesis:
    return max(hypotheses, key=lambda h: h.weight)


def _beside(
    judged: ExplanationPool,
    found: SearchResult,
    explanation: RankedExplanation,
    at: Sequence[str],
    places: int,
    best: CauseHypothesis,
) -> list[CauseHypothesis]:
    """Something unknown at some of the places beside an explanation, where it could matter beside the best."""
    needed = best.weight + math.log(RARE) - explanation.log_evidence - math.log(ODDS.unknown / places)
    found_there = localize(explanation.fitter, explanation.fit, explanation.noise, at, needed)
    return [_with_unknown(judged.fitter, found, explanation, place, places) for place in found_there]


def _with_unknown(
    fitter: Fitter, found: SearchResult, explanation: RankedExplanation, place: LocalizedDiscrepancy, places: int
) -> CauseHypothesis:
    causes = causes_in_order(explanation.fit)
    here = [c for c in causes if c[1] == place.location]
    weight = explanation.log_evidence + place.gain
    if here and _small(fitter, found, explanation, place):
        return CauseHypothesis(explanation, causes, weight)
    weight += math.log(ODDS.unknown / places)
    return CauseHypothesis(explanation, tuple(c for c in causes if c not in here), weight, place)


def _small(fitter: Fitter, found: SearchResult, explanation: RankedExplanation, place: LocalizedDiscrepancy) -> bool:
    """Whether a discrepancy is small beside what the explanation's effects at its place do to the readings."""
    rest = frozenset(c for c in explanation.key if c[1] != place.location)
    without = min((e for e in found.explanations if e.key <= rest), key=lambda e: _cost(fitter, e.fit))
    closed = _cost(fitter, without.fit) - _cost(fitter, explanation.fit)
    return place.size < ODDS.discrepancy * math.sqrt(max(closed, 0.0))


def _cost(fitter: Fitter, fit: Fit) -> float:
    return float(fitter.white(fit.linearised)[0].square().sum())


def _pruned(judged: ExplanationPool, found: SearchResult, best: CauseHypothesis, places: int) -> list[CauseHypothesis]:
    """Fewer effects: one may only have stood in for the unknown, or for what the law of another effect gets wrong."""
    kept: list[CauseHypothesis] = []
    while len(best.fit.key) > (0 if best.place else 1):
        tried = []
        for cause in best.fit.key:
            rest = judged.without(best.explanation, cause)
            at = [best.place.location] if best.place else list(dict.fromkeys(place for _, place in rest.key))
            tried += _beside(judged, found, rest, at, places, best)
        kept += tried
        if not tried or _best(tried).weight <= best.weight:
            break
        best = _best(tried)
    return kept


def _guilty(
    ranked: Iterable[CauseHypothesis], probabilities: Iterable[float], places: Sequence[str]
) -> tuple[tuple[str, float], ...]:
    share = dict.fromkeys(places, 0.0)
    for h, probability in zip(ranked, probabilities, strict=True):
        for at in {place for _, place in h.causes} | ({h.unknown_at} if h.unknown_at else set()):
            share[at] = share.get(at, 0.0) + probability
    return tuple(sorted(share.items(), key=lambda item: -item[1]))


def causes_in_order(fit: Fit) -> tuple[CauseName, ...]:
    """The causes of a fit as it places them."""
    return tuple((p.effect.name, p.location) for p in fit.candidate.placements)
