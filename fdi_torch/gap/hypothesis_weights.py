"""Weights of hypotheses: how the weight of a discrepancy is divided among the laws that may be behind it.

There are four cases. A discrepancy at a place with an effect is the error of that effect's law, or an unknown law. An
unknown may be an effect of the library at its place whose law is inexact. A second effect at a place may only describe
the error of the first one's law. An effect whose size may be zero may be absent.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import torch

from fdi_torch.effects import effect
from fdi_torch.estimate.evidence import ODDS, log_law_error, log_odds_of_law
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Key
from fdi_torch.gap.cause_hypothesis import CauseHypothesis, causes_in_order, influence, relative_size
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.library import tanks_of
from fdi_torch.gap.localization.localized_discrepancy import LocalizedDiscrepancy, unexplained_norm
from fdi_torch.gap.marginal_likelihood import log_prior, log_width, occam
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.gap.screening import Option
from fdi_torch.plant.description import PlantDescription


class HypothesisWeights:
    """Weights of hypotheses about a pool of explanations. options: effects that may be added. places: number of places
    where something unknown may be. log_odds: prior log odds of an unknown at one of them against none."""

    def __init__(self, pool: ExplanationPool, options: Sequence[Option], places: int) -> None:
        self.pool, self.options, self.places = pool, options, places
        self.log_odds = math.log(ODDS.unknown / places)

    @property
    def plant(self) -> PlantDescription:
        return self.pool.fitter.data.plant

    def named(self, h: CauseHypothesis) -> list[RankedExplanation]:
        """Explanations of the pool with one effect in place of the unknown of a hypothesis."""
        return [e for e in self.pool.explanations.values() if _names_unknown(e, h)]

    def with_discrepancy(self, explanation: RankedExplanation, at: LocalizedDiscrepancy) -> list[CauseHypothesis]:
        """An explanation with a discrepancy at one place, which may be the error of the law of an effect there.

        The odds divide the weight: both hypotheses together have the prior of the explanation. A discrepancy that
        changes only the cross-section of a tank is no error of a flow's law, but a second deviation there.
        """
        causes = causes_in_order(explanation.fit)
        # A random flow into a tank may stand for the error of any flow there.
        flow = at.noise.apart is not None
        beside = [c for c in causes if c[1] == at.location or (flow and at.location in tanks_of(c[1], self.plant))]
        effects = [c for c in beside if effect(c[0]).quantity in at.quantities]
        weight = explanation.log_weight + at.gain
        if not effects:
            odds = self.log_odds + (math.log(ODDS.same_place) if beside else 0.0)
            return [CauseHypothesis(explanation, causes, weight + odds, at)]
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
        return log_odds_of_law(error, self.pool.choices, self.places)

    def divided_among_effects(self, h: CauseHypothesis) -> list[CauseHypothesis]:
        """The hypothesis, and those of single effects in place of its unknown, with its weight divided among them."""
        if h.unknown is None:
            return [h]
        named = [e for e in self.named(h) if _may_be(h.unknown, e.key - set(h.causes))]
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
        return relative_size(fitter, fit, size, [c for c in sorted(named.key) if c[1] == unknown.location])

    def _log_likelihood(self, explanation: RankedExplanation) -> float:
        fitter, fit = explanation.fitter, explanation.fit
        residual, jacobian = (x[0] for x in fitter.white(fit.linearised))
        volume = occam(fitter, fit.space, fit.theta, jacobian, residual)
        return explanation.log_weight - log_prior(fit.key, self.pool.choices) - volume

    def with_inexact_laws(self, h: CauseHypothesis) -> list[CauseHypothesis]:
        """Variants without effects that may only describe the error of the law of another effect at their place.

        Such an effect costs its selection among all effects there instead of the prior odds of one more cause. One that
        changes the cross-section of a tank is no error of a flow's law.
        """
        explained: list[CauseHypothesis] = []
        fitter, fit = self.pool.fitter, h.explanation.fit
        for cause in h.causes:
            at_place = [c for c in h.causes if c[1] == cause[1] and effect(c[0]).quantity == effect(cause[0]).quantity]
            if len(at_place) > 1:
                error = relative_size(fitter, fit, influence(fitter, fit, [cause]), at_place)
                reduced = self.pool.refitted_without(h.explanation, cause)
                odds = log_prior(reduced.key, self.pool.choices) - log_prior(h.explanation.key, self.pool.choices)
                weight = h.weight + odds + self._log_selection(cause[1]) + log_law_error(error)
                others = tuple(c for c in h.causes if c != cause)
                law = CauseHypothesis(reduced, others, weight, h.discrepancy, h.inexact)
                explained += [law, *self.with_inexact_laws(law)]
        return explained

    def without_small_effects(self, h: CauseHypothesis) -> list[CauseHypothesis]:
        """The hypothesis without one or several of its effects, by the posterior over the prior density of their sizes
        at zero.

        This ratio is the Bayes factor for the hypothesis without these effects (Dickey, 1971), at the most likely onset
        and the like: of an effect of size zero, they are arbitrary. Beside a discrepancy, a fit without the effects may
        end in a local maximum instead.
        """
        if (at := h.discrepancy) is None:
            return []
        space, fitter = at.fit.space, self.pool.fitter
        low, high, _ = fitter.box(space)
        # Each with the effects that remain of the explanation, and with the parameters of those that do not.
        variants: list[tuple[CauseHypothesis, Key, dict[int, float]]] = [(h, h.explanation.key, {})]
        for p in at.fit.candidate.placements:
            size = p.full_name(p.effect.parameters(p.location, self.plant)[0].name)
            if p.cause not in h.causes or p.location == at.location or size not in space:
                continue
            i, nothing = space.index(size), space.parameters[space.index(size)].nominal
            shape = [space.index(n) for n in at.fit.values_of([p]) if n in space and n != size]
            for reduced, key, held in tuple(variants):
                fixed = held | {k: float(at.estimate.values[k]) for k in shape}
                density = at.estimate.log_density(i, nothing, (float(low[i]), float(high[i])), fixed)
                odds = log_prior(key - {p.cause}, self.pool.choices) - log_prior(key, self.pool.choices)
                weight = reduced.weight + density + log_width(fitter, space, i) + odds
                causes = tuple(c for c in reduced.causes if c != p.cause)
                variants.append(
                    (replace(reduced, causes=causes, weight=weight), key - {p.cause}, {**fixed, i: nothing})
                )
        return [variant for variant, _, _ in variants[1:]]


def _may_be(unknown: LocalizedDiscrepancy, effects: Collection[CauseName]) -> bool:
    """Whether the effects change what an unknown changes."""
    return unknown.quantities <= {effect(c[0]).quantity for c in effects}


def _shares(log_odds: Sequence[float]) -> list[float]:
    """Log probabilities of alternatives from their log odds against one more, which is the last."""
    return torch.log_softmax(torch.tensor([*log_odds, 0.0], dtype=torch.float64), dim=0).tolist()


def _names_unknown(explanation: RankedExplanation, h: CauseHypothesis) -> bool:
    """Whether an explanation has one effect instead of the unknown of a hypothesis, and else the same causes."""
    further = explanation.key - set(h.causes)
    return explanation.key.issuperset(h.causes) and [at for _, at in further] == [h.unknown_at]
