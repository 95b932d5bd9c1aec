"""Correlated residuals of a fit, and how much of the misfit its faults explain in spite of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fdi_torch.estimate.joint_fault_test import Fits
from fdi_torch.estimate.misfit import UNEXPLAINED_RATIO, least_noise
from fdi_torch.estimate.objectives import Problem, Term
from fdi_torch.estimate.whiteness import SIGNIFICANCE, correlated_share, correlation_inflation, ljung_box
from fdi_torch.parameters import ParameterSpace


@dataclass(frozen=True)
class TermResiduals:
    """Residuals (S, C) of one recording, weight 0 or 1. correlated (C,): not white by the portmanteau test."""

    values: Float[Tensor, "S C"]
    weight: Float[Tensor, "S C"]
    correlated: Bool[Tensor, " C"]

    @property
    def inflation(self) -> Float[Tensor, " C"]:
        """Variance inflation due to their correlation."""
        return correlation_inflation(self.values, self.weight, self.correlated)

    @property
    def lacking(self) -> Float[Tensor, " C"]:
        """Chi-square (C,) of what the model lacks: n times the correlated share of their variance."""
        share = torch.where(self.correlated, correlated_share(self.values, self.weight), 0.0)
        return self.weight.sum(0) * share


def residuals_of(term: Term, theta: Float[Tensor, "one P"], tests: int) -> TermResiduals:
    """The residuals of a recording at an estimate. tests: number of sensors in all recordings.

    Residuals as small as rounding of the readings, or as errors of the simulation, are correlated without any meaning.
    """
    values = term.data.known - term.engine.readings(term.theta(theta))[0]
    weight = (term.data.weight > 0).to(values)
    rms = (weight * values.square()).sum(0).sqrt() / weight.sum(0).clamp(min=1.0).sqrt()
    meaningful = rms > UNEXPLAINED_RATIO * least_noise(term.data.known, term.data.weight)
    return TermResiduals(values, weight, meaningful & (ljung_box(values, weight) < SIGNIFICANCE / tests))


def explained_share(
    likelihood: Problem,
    space: ParameterSpace,
    theta: Float[Tensor, " P"],
    faults: Sequence[int],
    residuals: Sequence[TermResiduals],
) -> float:
    """The share E / (E + L) of the misfit of the model without faults that the faults explain.

    E = sum over sensors of (SSR_0 - SSR) / (SSR / n), with SSR the sum of n squared residuals, and SSR_0 that of the
    best fit without `faults` (indices into `space`). L = sum over sensors of n rho, with rho the correlated share of
    the variance: what the model lacks. Both are in units of the variance of the residuals.
    """
    without = Fits(likelihood.linearise, space, theta).fit([tuple(faults)])[0]
    if without is None:
        return 1.0
    explained = lacking = 0.0
    for term, part in zip(likelihood.terms, residuals, strict=True):
        nominal = term.data.known - term.engine.readings(term.theta(without.theta[None]))[0]
        before, after = ((part.weight * e.square()).sum(0) for e in (nominal, part.values))
        explained += float((part.weight.sum(0) * (before - after) / after.clamp(min=1e-300)).sum())
        lacking += float(part.lacking.sum())
    return max(explained, 0.0) / max(max(explained, 0.0) + lacking, 1e-300)
