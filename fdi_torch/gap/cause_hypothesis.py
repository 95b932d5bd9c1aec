"""A hypothesis about the causes of a gap: a set of effects, with or without an unknown discrepancy at one place.

    log weight(S)    = log evidence of S + log prior of its random flows
    log weight(S, p) = log weight(S) + gain of a free discrepancy at p + log odds of an unknown there

each under its most likely disturbance noise (`marginal_likelihood.py`, `localization/localize.py`). No library
has the exact law of a rig (Brynjarsdottir and O'Hagan, 2014). A discrepancy at a place where S has an effect therefore
yields two hypotheses, which share its weight: the effect is right and its law is inexact, or an unknown law acts there
and the effect was fitted to a part of it. A small discrepancy, relative to the influence of the effect, favours the
first (`hypothesis_weights.py`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.answer import UNKNOWN, CauseName
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.localized_discrepancy import LocalizedDiscrepancy, unexplained_norm
from fdi_torch.gap.ranked_explanation import RankedExplanation
from fdi_torch.gap.start_choice import vector_of


@dataclass(frozen=True)
class CauseHypothesis:
    """An explanation with or without a discrepancy at one place.

    causes: effects of the explanation, without those that an unknown replaces. weight: log posterior, not normalised.
    discrepancy: an unknown; or, if `inexact`, the error of the law of an effect at the same place.
    """

    explanation: RankedExplanation
    causes: tuple[CauseName, ...]
    weight: float
    discrepancy: LocalizedDiscrepancy | None = None
    inexact: bool = False

    @property
    def unknown(self) -> LocalizedDiscrepancy | None:
        """The discrepancy, if it is an unknown."""
        return None if self.inexact else self.discrepancy

    @property
    def unknown_at(self) -> str | None:
        return self.unknown.location if self.unknown else None

    @property
    def all_causes(self) -> tuple[CauseName, ...]:
        """The causes, the unknown among them."""
        return (*self.causes, (UNKNOWN, self.unknown.location)) if self.unknown else self.causes

    @property
    def noise(self) -> StateNoise:
        return self.discrepancy.noise if self.discrepancy else self.explanation.noise

    @property
    def fit(self) -> Fit:
        return self.unknown.fit if self.unknown else self.explanation.fit


def likeliest(hypotheses: Collection[CauseHypothesis]) -> CauseHypothesis:
    return max(hypotheses, key=lambda h: h.weight)


def causes_in_order(fit: Fit) -> tuple[CauseName, ...]:
    """The causes of a fit in the order of its placements."""
    return tuple(p.cause for p in fit.candidate.placements)


def relative_size(fitter: Fitter, fit: Fit, size: float, effects: Collection[CauseName]) -> float:
    """Size of a deviation of the readings over the influence of some of a fit's effects, both in units of the noise."""
    return size / max(influence(fitter, fit, effects), 1e-12)


def influence(fitter: Fitter, fit: Fit, effects: Collection[CauseName]) -> float:
    """Norm of the influence of some of a fit's effects on the readings, in units of the sensor noise.

    The part that the other parameters can explain within their tolerances is projected out to first order.
    """
    others = [p for p in fit.candidate.placements if p.cause not in effects]
    engine = fitter.engine(Candidate(tuple(others)), list(fit.values_of(others)))
    theta = vector_of(engine.space, fit.values)
    reduced = engine.converge(theta.unsqueeze(0))
    change = fit.linearised.readings[0] - reduced.readings[0]
    return unexplained_norm(fitter, engine.space, theta, reduced.jacobian[0], change)
