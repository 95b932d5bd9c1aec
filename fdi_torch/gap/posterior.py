"""Posterior over the hypotheses about the causes of a gap (`cause_hypothesis.py`)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fdi_torch.estimate.evidence import posterior
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.cause_hypothesis import CauseHypothesis
from fdi_torch.gap.explanation_pool import ExplanationPool
from fdi_torch.gap.hypothesis_search import HypothesisSearch
from fdi_torch.gap.library import equivalence_class
from fdi_torch.gap.screening import Option
from fdi_torch.gap.structure_search import SearchResult
from fdi_torch.plant.description import PlantDescription


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
    search = HypothesisSearch(pool, options, places)
    named = search.alone(result.explanations)
    hypotheses = named if named_only else search.search(result, named)
    by_causes: dict[tuple[frozenset[frozenset[CauseName]], str | None], CauseHypothesis] = {}
    for h in sorted(hypotheses, key=lambda h: -h.weight):
        causes = frozenset(equivalence_class(c, plant, h.fit.values) for c in h.causes)
        by_causes.setdefault((causes, h.unknown_at), h)
    ranked = list(by_causes.values())
    unfitted = named[0].weight + math.log(max(result.unexamined, 1e-300))
    *probabilities, unexamined = posterior([*(h.weight for h in ranked), unfitted])
    return Posterior(tuple(ranked), tuple(probabilities), unexamined, _marginals(ranked, probabilities, places))


def _marginals(
    ranked: Iterable[CauseHypothesis], probabilities: Iterable[float], places: Sequence[str]
) -> tuple[tuple[str, float], ...]:
    """Marginal probability of a cause at each place, the likeliest first."""
    share = dict.fromkeys(places, 0.0)
    for h, probability in zip(ranked, probabilities, strict=True):
        for at in {place for _, place in h.causes} | ({h.unknown_at} if h.unknown_at else set()):
            share[at] = share.get(at, 0.0) + probability
    return tuple(sorted(share.items(), key=lambda item: -item[1]))
