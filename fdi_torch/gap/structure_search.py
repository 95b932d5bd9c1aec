"""Structure search: the sets of effects that explain a recording, each judged by its evidence.

A forward search with a beam: about each of the best explanations so far, the most promising effects are fitted and
evaluated (`explanation_pool.py`). Finally, each effect of the best explanation is removed or exchanged while that
improves it (floating search: Pudil, Novovicova and Kittler, 1994).

The screening is repeated with a second noise model, that of the sensors alone. The disturbance noise of an explanation
that lacks a cause is too large, because it absorbs the cause, and hides further small causes. The sensor noise alone,
however, overrates effects that only compensate a wrong equation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fdi_torch.estimate.evidence import RARE
from fdi_torch.gap.explanation_pool import BEAM, EXTENSION, ExplanationPool
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.gap.screening import Option, Pairs, ScreeningResult, pairs_of, screen, screen_under_each

# Budgets of computing.
MAX_EFFECTS = 4  # effects in one explanation
FINAL_ROUNDS = 4  # rounds in which further unfitted candidates are fitted


@dataclass(frozen=True)
class SearchResult:
    """The explanations of a recording.

    explanations: all that were evaluated, the likeliest first. null: the recalibrated plant among them. null_screening:
    screening about the recalibrated plant under its own noise. null_pairs: regression on pairs about the recalibrated
    plant under the noise of the best explanation. unexamined: odds of the candidates that were not fitted, against the
    best explanation.
    """

    null: RankedExplanation
    explanations: tuple[RankedExplanation, ...]
    null_screening: ScreeningResult
    null_pairs: Pairs
    unexamined: float

    @property
    def best(self) -> RankedExplanation:
        return self.explanations[0]


def search(pool: ExplanationPool, options: Sequence[Option], most: int = MAX_EFFECTS) -> SearchResult:
    """Search from the recalibrated plant. most: effects in one explanation."""
    pool.progress.remaining(EXTENSION * (1 + BEAM * (most - 1)))
    base = pool.evaluate(pool.null)
    null_screening, of_sensors = screen_under_each([base.fitter, pool.fitter], base.fit, options)
    pool.extend(base, null_screening, of_sensors)
    pool.progress.so_far(pool.best.key)
    frontier = pool.best_of(1)[:BEAM]
    for depth in range(2, most + 1):
        if not frontier or frontier[0].log_evidence < pool.best_of(depth - 2)[0].log_evidence:
            break
        for k, parent in enumerate(frontier):
            pool.progress.remaining(EXTENSION * (len(frontier) - k + BEAM * (most - depth)))
            pool.extend_by(parent, options)
            pool.progress.so_far(pool.best.key)
        frontier = pool.best_of(depth)[:BEAM]
    pool.progress.remaining(EXTENSION * (1 + len(pool.best.key)))
    pool.exchange_effects(options)
    for _ in range(FINAL_ROUNDS):
        if pool.unexamined() < RARE:
            break
        pool.fit_unexamined()
    explanations = sorted(pool.explanations.values(), key=lambda e: -e.log_evidence)
    if pool.explanations[base.key] is not base:
        base = pool.explanations[base.key]
        null_screening = screen(base.fitter, base.fit, options)
    likeliest = explanations[0].fitter
    screening = null_screening if likeliest is base.fitter else screen(likeliest, base.fit, options)
    null_pairs = pairs_of(likeliest, base.fit, screening)
    return SearchResult(base, tuple(explanations), null_screening, null_pairs, pool.unexamined())
