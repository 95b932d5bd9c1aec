"""Search over hypotheses with a discrepancy: which unknown, beside which effects.

It starts from the explanations that the structure search found. At each place a discrepancy is evaluated, once beside
the likeliest explanation and once beside no effect. From the likeliest hypothesis, effects are then removed and added,
and the discrepancy is moved to other places, as long as that improves it: an effect may only have compensated the
discrepancy, which may also have hidden an effect.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from fdi_torch.estimate.evidence import RARE
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Candidate, Fit, Key
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.cause_hypothesis import (
    CauseHypothesis,
    causes_in_order,
    likeliest,
)
from fdi_torch.gap.explanation_pool import EXTENSION, ExplanationPool
from fdi_torch.gap.hypothesis_weights import HypothesisWeights
from fdi_torch.gap.localization.localize import CALIBRATED, Shortfall, localize, localize_beside
from fdi_torch.gap.localization.localized_discrepancy import (
    LocalizedDiscrepancy,
    log_likelihood,
    nearly_without_disturbances,
)
from fdi_torch.gap.marginal_likelihood import log_prior, with_disturbances
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.gap.screening import Option
from fdi_torch.gap.structure_search import SearchResult


class HypothesisSearch:
    """The hypotheses about a pool of explanations, which grows.

    options: effects that may be added. places: where something unknown may be.
    """

    def __init__(self, pool: ExplanationPool, options: Sequence[Option], places: Sequence[str]) -> None:
        self.pool, self.options, self.places = pool, options, places
        self.weights = HypothesisWeights(pool, options, len(places))
        # By the explanation's id, and the place; and the explanations' ids.
        self._evaluated: dict[tuple[int, str], list[CauseHypothesis]] = {}
        self._at_all_places: set[int] = set()
        self._shortfall = Shortfall()
        # Unknowns at whose place the effects of the library were fitted: the causes beside each, and its place.
        self._with_names: set[tuple[frozenset[CauseName], str]] = set()

    def search(self, result: SearchResult, named: Sequence[CauseHypothesis]) -> list[CauseHypothesis]:
        """All hypotheses that were examined. named: those without a discrepancy."""
        hypotheses = list(named)
        first = {e.key: e for e in (result.null, likeliest(named).explanation)}.values()
        for k, explanation in enumerate(first):
            self.pool.progress.remaining((len(first) - k) * len(self.places) + EXTENSION)
            hypotheses += self._everywhere(explanation, likeliest(hypotheses))
            self.pool.progress.so_far(likeliest(hypotheses).all_causes)
        hypotheses = self._after_fits_at_unknowns(hypotheses)
        trials = self._climbed(likeliest(hypotheses))
        best = likeliest([*hypotheses, *trials])
        if best.discrepancy and any(at != best.discrepancy.location for _, at in best.explanation.key):
            alone = self._with_discrepancies(result.null, [best.discrepancy.location])
            trials += [*alone, *self._climbed(likeliest(alone))]
        hypotheses += self._after_fits_at_unknowns(trials, likeliest(hypotheses).weight)
        least = likeliest(hypotheses).weight + math.log(RARE)
        hypotheses += [law for h in hypotheses if h.weight > least for law in self.weights.with_inexact_laws(h)]
        return hypotheses + [
            fewer for h in hypotheses if h.weight > least for fewer in self.weights.without_small_effects(h)
        ]

    def alone(self, explanations: Sequence[RankedExplanation]) -> list[CauseHypothesis]:
        """Explanations without a discrepancy, linearised about the levels that they predict, where discrepancies are:
        their gains shall not contain that of another point.

        explanations: the likeliest first. If an explanation would remain irrelevant with the largest gain so far, that
        linearisation is not computed, and its evidence about its own trajectory is used.
        """
        hypotheses, best, largest = list[CauseHypothesis](), -math.inf, 0.0
        for k, e in enumerate(explanations):
            gain, needed = 0.0, best + math.log(RARE) - e.log_weight
            if k < CALIBRATED or largest > needed:
                gain = localize(e.fitter, e.fit, e.noise, (), needed=needed).itself
            best, largest = max(best, e.log_weight + gain), max(largest, gain)
            hypotheses.append(CauseHypothesis(e, causes_in_order(e.fit), e.log_weight + gain))
        return hypotheses

    def _everywhere(self, explanation: RankedExplanation, best: CauseHypothesis) -> list[CauseHypothesis]:
        """An explanation with a discrepancy at each place; none if it was evaluated before."""
        if id(explanation) in self._at_all_places:
            return []
        self._at_all_places.add(id(explanation))
        return self._with_discrepancies(explanation, self.places, best)

    def _with_discrepancies(
        self, explanation: RankedExplanation, at: Sequence[str], best: CauseHypothesis | None = None
    ) -> list[CauseHypothesis]:
        """An explanation alone, and with a discrepancy at each of the places unless it is far worse than `best`."""
        known = [h for place in at for h in self._evaluated.get((id(explanation), place), ())]
        at = [place for place in at if (id(explanation), place) not in self._evaluated]
        if not at:
            return known
        needed, rival = (self._needed(explanation, best), best.noise) if best else (-math.inf, None)
        fitter, fit, noise = explanation.fitter, explanation.fit, explanation.noise
        odds, step = self.weights.log_odds, self.pool.progress.step
        localization = localize(
            fitter, fit, noise, at, needed=needed, rival=rival, log_odds=odds, earlier=self._shortfall, step=step
        )
        hypotheses = {
            (id(explanation), d.location): self.weights.with_discrepancy(explanation, d)
            for d in localization.discrepancies
        }
        self._evaluated |= hypotheses
        causes = causes_in_order(explanation.fit)
        alone = CauseHypothesis(explanation, causes, explanation.log_weight + localization.itself)
        return [alone, *known, *(h for each in hypotheses.values() for h in each)]

    def _climbed(self, best: CauseHypothesis) -> list[CauseHypothesis]:
        """Hypotheses with an effect fewer or more than the best, or else with a discrepancy at another place, while
        that improves it. The discrepancy moves beside the same effects, or beside one more in its former place."""
        evaluated: list[CauseHypothesis] = []
        while True:
            self.pool.progress.remaining(2 * EXTENSION)  # this round, and one that may follow
            self.pool.progress.so_far(best.all_causes)
            trials = [*self._with_fewer_effects(best), *self._with_more_effects(best)]
            if best.discrepancy and all(h.weight <= best.weight for h in trials):
                trials += self._everywhere(best.explanation, best)
                if named := self._named(best):
                    trials += self._everywhere(max(named, key=lambda e: e.log_weight), best)
            evaluated += trials
            if not trials or likeliest(trials).weight <= best.weight:
                return evaluated
            best = likeliest(trials)

    def _with_fewer_effects(self, best: CauseHypothesis) -> list[CauseHypothesis]:
        """Variants of a hypothesis without one of its effects, with its discrepancy or, if it has none, one at any
        place: the effect may only have compensated it."""
        if (at := best.discrepancy) is not None:
            beside = _without_discrepancy(best, at)
            reduced = [
                tuple(p for p in best.fit.candidate.placements if (p.effect.name, p.location) != cause)
                for cause in sorted(best.explanation.key)
            ]
            fits = [beside.fit(Candidate(p, (at.fit.values_of(p),)), at.fit) for p in reduced]
            return self._with_the_same(at, fits, best)
        if len(best.explanation.key) < 2:
            return []
        explanations = [self.pool.without(best.explanation, cause) for cause in sorted(best.explanation.key)]
        return [h for e in explanations for h in self._with_discrepancies(e, self.places, best)]

    def _with_more_effects(self, best: CauseHypothesis) -> list[CauseHypothesis]:
        """Variants of a hypothesis with one of the most promising further effects beside the discrepancy.

        They are chosen under the noise that the discrepancy left, and nearly without random flows, which may have
        absorbed an effect.
        """
        if (at := best.discrepancy) is None:
            return []
        beside = _without_discrepancy(best, at)
        base = beside.fit(replace(at.fit.candidate, starts=(at.fit.effect_values,)), at.fit)
        undisturbed = with_disturbances(beside, base, nearly_without_disturbances(at.noise))
        fits: dict[Key, Fit] = {}
        for fitter in (beside, undisturbed):
            for fit in self.pool.fits_beside(fitter, base, self.options):
                fits.setdefault(fit.key, fit)
        return self._with_the_same(at, fits.values(), best)

    def _with_the_same(
        self, at: LocalizedDiscrepancy, fits: Iterable[Fit], best: CauseHypothesis
    ) -> list[CauseHypothesis]:
        """Hypotheses with other effects beside the same discrepancy. fits: of these effects, to the readings without
        what it explains. best: likeliest hypothesis so far."""
        noise, hypotheses = best.explanation.noise, list[CauseHypothesis]()
        for fit in fits:
            fitter = with_disturbances(self.pool.fitter, fit, noise)
            evidence = log_likelihood(fitter, fit, fit.linearised) + log_prior(fit.key, self.pool.choices)
            explanation = RankedExplanation(replace(fit, cost=fitter.cost(fit)), fitter, noise, evidence)
            if discrepancy := localize_beside(fitter, fit, noise, at, self._needed(explanation, best)):
                hypotheses += self.weights.with_discrepancy(explanation, discrepancy)
        return hypotheses

    def _needed(self, explanation: RankedExplanation, best: CauseHypothesis) -> float:
        """Log evidence that a discrepancy must add to give the explanation the share RARE of the best one's weight."""
        return best.weight + math.log(RARE) - explanation.log_weight - self.weights.log_odds

    def _after_fits_at_unknowns(
        self, hypotheses: Sequence[CauseHypothesis], rival: float = -math.inf
    ) -> list[CauseHypothesis]:
        """The hypotheses after the effects of the library were fitted at the place of each unknown that is relevant.

        An unknown is a law that no library has. Its weight is divided among it and the effects at the same place, whose
        laws may be inexact. rival: weight of the likeliest of all others.
        """
        added: list[CauseHypothesis] = []
        least = max([rival, *(h.weight for h in hypotheses)]) + math.log(RARE)
        for h in hypotheses:
            if h.unknown and h.weight > least:
                named = self._named(h)
                added += [law for e in named for law in self._with_discrepancies(e, [h.unknown.location], h)]
        return [
            each for h in [*hypotheses, *added] for each in (self.weights.among_known(h) if h.weight > least else [h])
        ]

    def _named(self, h: CauseHypothesis) -> list[RankedExplanation]:
        """Explanations with one effect in place of the unknown of a hypothesis; the most promising are fitted once."""
        if h.unknown is None:
            return []
        if (unknown := (frozenset(h.causes), h.unknown.location)) not in self._with_names:
            self._with_names.add(unknown)
            self._fit_effects_at(h, h.unknown)
        return self.weights.named(h)

    def _fit_effects_at(self, h: CauseHypothesis, unknown: LocalizedDiscrepancy) -> None:
        """Fit and evaluate the most promising effects at the place of the unknown of a hypothesis."""
        noise = replace(unknown.noise, wander=None)
        under = with_disturbances(h.explanation.fitter, h.fit, noise)
        at_place = [o for o in self.options if o.placement.location == unknown.location]
        others = tuple(p for p in h.fit.candidate.placements if (p.effect.name, p.location) in h.causes)
        base = under.fit(Candidate(others, (h.fit.values_of(others),)), h.fit)
        for fit in self.pool.fits_beside(under, base, at_place):
            self.pool.evaluate(fit, noise)


def _without_discrepancy(h: CauseHypothesis, at: LocalizedDiscrepancy) -> Fitter:
    """Fitter of the readings without what the discrepancy of a hypothesis explains, under the noise that this left."""
    under = with_disturbances(h.explanation.fitter, at.fit, at.noise)
    corrected = replace(under.data, readings=under.data.readings - at.explained)
    return under.of(corrected)
