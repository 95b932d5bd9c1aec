"""Search over hypotheses with a discrepancy: which unknown, beside which effects.

It starts from the explanations that the structure search found. Beside the likeliest, and beside none, a discrepancy is
evaluated at each place. About the likeliest hypothesis, effects are then removed and added, and the discrepancy moved
to other places, while that improves it: an effect may only have compensated the discrepancy, which may also have hidden
an effect.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch

from fdi_torch.estimate.evidence import ODDS, RARE, log_law_error, log_odds_of_law
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.cause_hypothesis import (
    CauseHypothesis,
    causes_in_order,
    influence,
    likeliest,
    relative_size,
)
from fdi_torch.gap.explanation_pool import ExplanationPool, RankedExplanation
from fdi_torch.gap.library import tanks_of
from fdi_torch.gap.localization.localize import localize, localize_beside
from fdi_torch.gap.localization.localized_discrepancy import (
    LocalizedDiscrepancy,
    log_likelihood,
    unexplained_norm,
)
from fdi_torch.gap.marginal_likelihood import log_prior, log_width, occam, with_disturbances
from fdi_torch.gap.screening import Option
from fdi_torch.gap.structure_search import SearchResult
from fdi_torch.plant.description import PlantDescription


class HypothesisSearch:
    """The hypotheses about a pool of explanations, which grows.

    options: effects that may be added. places: where something unknown may be.
    """

    def __init__(self, pool: ExplanationPool, options: Sequence[Option], places: Sequence[str]) -> None:
        self.pool, self.options, self.places = pool, options, places
        self._log_odds = math.log(ODDS.unknown / len(places))
        # By the explanation's id, and the place; and the explanations' ids.
        self._evaluated: dict[tuple[int, str], list[CauseHypothesis]] = {}
        self._at_all_places: set[int] = set()
        # Unknowns at whose place the effects of the library were fitted: the causes beside each, and its place.
        self._with_names: set[tuple[frozenset[CauseName], str]] = set()

    @property
    def plant(self) -> PlantDescription:
        return self.pool.fitter.data.plant

    def search(self, result: SearchResult, named: Sequence[CauseHypothesis]) -> list[CauseHypothesis]:
        """All hypotheses that were examined. named: those without a discrepancy."""
        hypotheses = list(named)
        for explanation in {e.key: e for e in (likeliest(named).explanation, result.null)}.values():
            hypotheses += self._everywhere(explanation, likeliest(hypotheses))
        hypotheses = self._after_fits_at_unknowns(hypotheses)
        trials = self._climbed(likeliest(hypotheses))
        best = likeliest([*hypotheses, *trials])
        if best.discrepancy and any(at != best.discrepancy.location for _, at in best.explanation.key):
            alone = self._with_discrepancies(result.null, [best.discrepancy.location])
            trials += [*alone, *self._climbed(likeliest(alone))]
        hypotheses += self._after_fits_at_unknowns(trials, likeliest(hypotheses).weight)
        least = likeliest(hypotheses).weight + math.log(RARE)
        hypotheses += [law for h in hypotheses if h.weight > least for law in self._with_inexact_laws(h)]
        return hypotheses + [fewer for h in hypotheses if h.weight > least for fewer in self._without_small_effects(h)]

    def alone(self, explanation: RankedExplanation, best: float) -> CauseHypothesis:
        """An explanation without a discrepancy, linearised about the levels that it predicts, where discrepancies are:
        their gains shall not contain that of another point. best: weight of the likeliest explanation."""
        needed = best + math.log(RARE) - explanation.log_weight
        gain = localize(explanation.fitter, explanation.fit, explanation.noise, (), needed=needed).itself
        return CauseHypothesis(explanation, causes_in_order(explanation.fit), explanation.log_weight + gain)

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
        if all((id(explanation), place) in self._evaluated for place in at):
            return [h for place in at for h in self._evaluated[id(explanation), place]]
        needed, rival = (self._needed(explanation, best), best.noise) if best else (-math.inf, None)
        fitter, fit, noise = explanation.fitter, explanation.fit, explanation.noise
        localization = localize(fitter, fit, noise, at, needed=needed, rival=rival, log_odds=self._log_odds)
        hypotheses = {
            (id(explanation), d.location): self._with_discrepancy(explanation, d) for d in localization.discrepancies
        }
        self._evaluated |= hypotheses
        causes = causes_in_order(explanation.fit)
        alone = CauseHypothesis(explanation, causes, explanation.log_weight + localization.itself)
        return [alone, *(h for each in hypotheses.values() for h in each)]

    def _with_discrepancy(self, explanation: RankedExplanation, at: LocalizedDiscrepancy) -> list[CauseHypothesis]:
        """An explanation with a discrepancy at one place, which may be the error of the law of an effect there."""
        causes = causes_in_order(explanation.fit)
        # A random flow into a tank may stand for the error of any flow there.
        flow = at.noise.apart is not None
        effects = [c for c in causes if c[1] == at.location or (flow and at.location in tanks_of(c[1], self.plant))]
        weight = explanation.log_weight + at.gain
        if not effects:
            return [CauseHypothesis(explanation, causes, weight + self._log_odds, at)]
        error = relative_size(self.pool.fitter, explanation.fit, at.size, effects) if at.size > 0.0 else None
        law, other = _shares([self._log_odds_of_law(error)])
        other += sum(self._log_selection(place) for _, place in effects)  # they describe a part of the other law
        return [
            CauseHypothesis(explanation, causes, weight + law, at, inexact=True),
            CauseHypothesis(explanation, tuple(c for c in causes if c not in effects), weight + other, at),
        ]

    def _log_selection(self, place: str) -> float:
        """Log probability of one of the effects at a place, if it is not a cause but describes a part of one."""
        return -math.log(len({o.cause for o in self.options if o.cause[1] == place}))

    def _log_odds_of_law(self, error: float | None) -> float:
        return log_odds_of_law(error, self.pool.choices, len(self.places))

    def _climbed(self, best: CauseHypothesis) -> list[CauseHypothesis]:
        """Hypotheses with an effect fewer or more than the best, or else with a discrepancy at another place, while
        that improves it. The discrepancy moves beside the same effects, or beside one more in its former place."""
        evaluated: list[CauseHypothesis] = []
        while True:
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
        """Variants of a hypothesis without one of its effects, with its discrepancy or one at an effect's place."""
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
        return [h for e in explanations for h in self._with_discrepancies(e, sorted({at for _, at in e.key}), best)]

    def _with_more_effects(self, best: CauseHypothesis) -> list[CauseHypothesis]:
        """Variants of a hypothesis with one of the most promising further effects beside the discrepancy."""
        if (at := best.discrepancy) is None:
            return []
        beside = _without_discrepancy(best, at)
        base = beside.fit(replace(at.fit.candidate, starts=(at.fit.effect_values,)), at.fit)
        return self._with_the_same(at, self.pool.fits_beside(beside, base, self.options), best)

    def _with_the_same(
        self, at: LocalizedDiscrepancy, fits: Iterable[Fit], best: CauseHypothesis
    ) -> list[CauseHypothesis]:
        """Other effects with the same discrepancy. fits: beside it. best: likeliest hypothesis so far."""
        noise, hypotheses = best.explanation.noise, list[CauseHypothesis]()
        for fit in fits:
            fitter = with_disturbances(self.pool.fitter, fit, noise)
            evidence = log_likelihood(fitter, fit, fit.linearised) + log_prior(fit.key, self.pool.choices)
            explanation = RankedExplanation(replace(fit, cost=fitter.cost(fit)), fitter, noise, evidence)
            if discrepancy := localize_beside(fitter, fit, noise, at, self._needed(explanation, best)):
                hypotheses += self._with_discrepancy(explanation, discrepancy)
        return hypotheses

    def _needed(self, explanation: RankedExplanation, best: CauseHypothesis) -> float:
        """Gain of a discrepancy beside an explanation from which on it is relevant against the best hypothesis."""
        return best.weight + math.log(RARE) - explanation.log_weight - self._log_odds

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
        return [each for h in [*hypotheses, *added] for each in (self._among_known(h) if h.weight > least else [h])]

    def _named(self, h: CauseHypothesis) -> list[RankedExplanation]:
        """Explanations with one effect in place of the unknown of a hypothesis; the most promising are fitted once."""
        if h.unknown is None:
            return []
        if (unknown := (frozenset(h.causes), h.unknown.location)) not in self._with_names:
            self._with_names.add(unknown)
            self._fit_effects_at(h, h.unknown)
        return [e for e in self.pool.explanations.values() if _names_unknown(e, h)]

    def _fit_effects_at(self, h: CauseHypothesis, unknown: LocalizedDiscrepancy) -> None:
        """Fit and evaluate the most promising effects at the place of the unknown of a hypothesis."""
        noise = replace(unknown.noise, wander=None)
        under = with_disturbances(h.explanation.fitter, h.fit, noise)
        at_place = [o for o in self.options if o.placement.location == unknown.location]
        others = tuple(p for p in h.fit.candidate.placements if (p.effect.name, p.location) in h.causes)
        base = under.fit(Candidate(others, (h.fit.values_of(others),)), h.fit)
        for fit in self.pool.fits_beside(under, base, at_place):
            self.pool.evaluate(fit, noise)

    def _among_known(self, h: CauseHypothesis) -> list[CauseHypothesis]:
        """The hypothesis, and those of single effects in place of its unknown, with its weight divided among them."""
        if h.unknown is None:
            return [h]
        named = [e for e in self.pool.explanations.values() if _names_unknown(e, h)]
        errors = [self._law_error(e, h.explanation, h.unknown) for e in named]
        *shares, other = _shares([self._log_odds_of_law(error) for error in errors])
        weights = [h.weight + share for share in shares]
        known = [CauseHypothesis(e, causes_in_order(e.fit), w) for e, w in zip(named, weights, strict=True)]
        return [*known, replace(h, weight=h.weight + other)]

    def _law_error(
        self, named: RankedExplanation, explanation: RankedExplanation, unknown: LocalizedDiscrepancy
    ) -> float | None:
        """Relative error of the law of the effect that `named` has in place of an unknown, if the unknown is true.

        None if the effect predicts as well by Akaike's criterion (1974), which costs one nat for each parameter.
        """
        fitter, fit = self.pool.fitter, named.fit
        better = self._log_likelihood(explanation) + unknown.log_likelihood - self._log_likelihood(named)
        if better <= unknown.parameters + len(explanation.fit.space) - len(fit.space):
            return None
        if unknown.predicted is None:
            return math.inf
        difference = unknown.predicted - fit.linearised.readings[0]
        size = unexplained_norm(fitter, fit.space, fit.theta, fit.linearised.jacobian[0], difference)
        return relative_size(fitter, fit, size, [c for c in named.key if c[1] == unknown.location])

    def _log_likelihood(self, explanation: RankedExplanation) -> float:
        fitter, fit = explanation.fitter, explanation.fit
        volume = occam(fitter, fit.space, fit.theta, fitter.whiten(fit.linearised.jacobian[0]))
        return explanation.log_weight - log_prior(fit.key, self.pool.choices) - volume

    def _with_inexact_laws(self, h: CauseHypothesis) -> list[CauseHypothesis]:
        """Variants without effects that may only describe the error of the law of another effect at their place.

        Such an effect costs its selection among all effects there instead of the prior odds of one more cause.
        """
        explained: list[CauseHypothesis] = []
        fitter, fit = self.pool.fitter, h.explanation.fit
        for cause in h.causes:
            at_place = [c for c in h.causes if c[1] == cause[1]]
            if len(at_place) > 1:
                error = relative_size(fitter, fit, influence(fitter, fit, [cause]), at_place)
                reduced = self.pool.without(h.explanation, cause)
                odds = log_prior(reduced.key, self.pool.choices) - log_prior(h.explanation.key, self.pool.choices)
                weight = h.weight + odds + self._log_selection(cause[1]) + log_law_error(error)
                others = tuple(c for c in h.causes if c != cause)
                law = CauseHypothesis(reduced, others, weight, h.discrepancy, h.inexact)
                explained += [law, *self._with_inexact_laws(law)]
        return explained

    def _without_small_effects(
        self, h: CauseHypothesis, left_out: frozenset[CauseName] = frozenset()
    ) -> list[CauseHypothesis]:
        """The hypothesis without some of its effects, by the posterior over the prior density of their sizes at zero.

        This ratio is the Bayes factor for the hypothesis without an effect (Dickey, 1971). Beside a discrepancy, a fit
        without the effect may end in a local maximum instead. left_out: effects that `h` lacks.
        """
        fewer: list[CauseHypothesis] = []
        if (at := h.discrepancy) is None:
            return fewer
        for p in at.fit.candidate.placements:
            cause, name = (p.effect.name, p.location), p.full_name(p.effect.parameters(p.location, self.plant)[0].name)
            if cause in h.causes and p.location != at.location and name in at.fit.space:
                i, fitter = at.fit.space.index(name), self.pool.fitter
                low, high, _ = fitter.box(at.fit.space)
                nothing = at.fit.space.parameters[i].nominal
                density = at.estimate.log_density(i, nothing, (float(low[i]), float(high[i])))
                ratio = density + log_width(fitter, at.fit.space, i) + 0.5 * math.log(2.0 * math.pi)
                key, without = h.explanation.key - left_out, left_out | {cause}
                odds = log_prior(key - {cause}, self.pool.choices) - log_prior(key, self.pool.choices)
                others = tuple(c for c in h.causes if c != cause)
                reduced = replace(h, causes=others, weight=h.weight + ratio + odds)
                fewer += [reduced, *self._without_small_effects(reduced, without)]
        return fewer


def _shares(log_odds: Sequence[float]) -> list[float]:
    """Log probabilities of alternatives from their log odds against one more, which is the last."""
    return torch.log_softmax(torch.tensor([*log_odds, 0.0], dtype=torch.float64), dim=0).tolist()


def _without_discrepancy(h: CauseHypothesis, at: LocalizedDiscrepancy) -> Fitter:
    """Fitter of the readings without what the discrepancy of a hypothesis explains, under the noise that this left."""
    under = with_disturbances(h.explanation.fitter, at.fit, at.noise)
    corrected = replace(under.data, readings=under.data.readings - at.explained)
    return under.of(corrected)


def _names_unknown(explanation: RankedExplanation, h: CauseHypothesis) -> bool:
    """Whether an explanation has one effect instead of the unknown of a hypothesis, and else the same causes."""
    further = explanation.key - set(h.causes)
    return explanation.key.issuperset(h.causes) and [at for _, at in further] == [h.unknown_at]
