"""Joint test of suspected faults, and the rivals among them of which at least one is present.

Faults that act alike have large standard errors, so that none of them differs from nominal alone, however certain it is
that one is present. The joint test of a set R of faults compares the estimate with the best fit without them,

    Lambda = 2 (min over theta with theta_R nominal of f(theta) - min f(theta)),

with f the negative log-likelihood, priors included. Without a fault, Lambda has a chi-square distribution with |R|
degrees of freedom (Wilks 1938, Annals of Mathematical Statistics 9:60). It is smaller if a nominal size is an end of a
range (Self and Liang 1987), so that the test is then conservative. Other parameters of these faults, such as an onset,
count as degrees of freedom as well. The threshold also holds for each subset of R
(Scheffe 1953, Biometrika 40:87).

Small subsets S of R are then explanations, in which the other faults of R are nominal. Their probabilities, given that
at least one is present, follow from the evidence of `estimate.evidence`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import log_prior, log_volume, posterior
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import Linearise, Refined, held_back
from fdi_torch.estimate.refinement import CONVERGED_WITHIN, TIGHT_DECREASE
from fdi_torch.estimate.rival_faults import Explanation, RivalFaults
from fdi_torch.parameters import ParameterName, ParameterSpace, common_name

SETTINGS = RefineSettings(iterations=200, decrease_tolerance=TIGHT_DECREASE)
LEAST_PROBABILITY, LEAST_LISTED = 0.01, 2
"""Explanations below this probability are not listed, but at least so many."""
SUFFICIENT = 0.05
"""Faults suffice if one more fault lowers the misfit by no more than chance does with this probability."""
MOST_EXTENDED = 8
"""The likeliest explanations of one number of faults that are extended by one more."""
MOST_FAULTS = 4
"""The largest number of faults in one explanation."""


def rival_faults(
    linearise: Linearise, space: ParameterSpace, theta: Tensor, tested: Sequence[int], level: float
) -> RivalFaults | None:
    """The rivals among the faults `tested` (indices into `space`), None unless they differ from nominal together.

    linearise: of the negative log-likelihood with known noise. theta (P,): the estimate. level: confidence level.
    """
    fits = Fits(linearise, space, theta)
    without = fits.fit([tuple(tested)])[0]
    if without is None or fits.p_value(without, tested) >= 1.0 - level:
        return None
    explanations = _explanations(fits, tested)
    weights = posterior([fits.log_evidence(e, tested) for e in explanations])
    ranked = sorted(zip(explanations, weights, strict=True), key=lambda pair: -pair[1])
    listed_ones = [pair for k, pair in enumerate(ranked) if k < LEAST_LISTED or pair[1] >= LEAST_PROBABILITY]
    rivals = tuple(i for i in tested if any(i in e.present for e, _ in listed_ones))
    subset = fits.fit([rivals])[0]
    if subset is None or fits.p_value(subset, tested) >= 1.0 - level:
        rivals, subset = tuple(tested), without
    return RivalFaults(
        tuple(space.names[i] for i in rivals),
        fits.ratio(subset),
        1.0 - fits.p_value(subset, tested),
        tuple(e.described(space, w) for e, w in listed_ones),
    )


@dataclass(frozen=True)
class Fit:
    """Best fit with some faults nominal. free (P,) bool: parameters that were fitted. present: the tested faults that
    were."""

    cost: float
    theta: Tensor
    gradient: Tensor
    curvature: Tensor
    free: Tensor
    present: tuple[int, ...] = ()

    def described(self, space: ParameterSpace, probability: float) -> Explanation:
        std, each = certainty(self.curvature, ~self.free).std, self.present
        values, errors = (tuple(float(x[i]) for i in each) for x in (self.theta, std))
        names, units = (tuple(getattr(space.parameters[i], key) for i in each) for key in ("name", "unit"))
        return Explanation(names, units, values, errors, probability)


class Fits:
    """Fits from an estimate, with some faults held at their nominal sizes."""

    def __init__(self, linearise: Linearise, space: ParameterSpace, theta: Tensor) -> None:
        self.linearise, self.space, self.theta = linearise, space, theta
        self.low, self.high, self.nominal = (x.to(theta) for x in (space.low(), space.high(), space.nominal()))
        self.lowest = float(linearise(theta[None], torch.zeros(1, dtype=torch.int64)).cost)

    def shapes(self, faults: Sequence[int]) -> list[int]:
        """The other parameters of these faults, such as an onset."""
        prefixes = {ParameterName.parse(self.space.names[i]).prefix for i in faults}
        named = enumerate(self.space.names)
        return [i for i, n in named if i not in faults and ParameterName.parse(common_name(n)).prefix in prefixes]

    def ratio(self, fit: Fit) -> float:
        """Likelihood ratio of a fit against the best one."""
        return max(2.0 * (fit.cost - self.lowest), 0.0)

    def p_value(self, fit: Fit, faults: Sequence[int]) -> float:
        """Probability of such a ratio by chance, of chi-square with one degree of freedom for each parameter of the
        faults."""
        degrees = len(faults) + len(self.shapes(faults))
        half = torch.tensor([0.5 * degrees, 0.5 * self.ratio(fit)], dtype=torch.float64)
        return float(torch.special.gammaincc(half[0], half[1]))

    def fit(self, held: Sequence[tuple[int, ...]]) -> list[Fit | None]:
        """The best fits with these faults nominal, None for one that did not converge.

        Each starts twice: at the estimate, and there with the constants of the plant nominal. The shape of a nominal
        fault has no effect and stays as estimated.
        """
        low, high = self.low.repeat(len(held), 1), self.high.repeat(len(held), 1)
        for row, which in enumerate(held):
            shapes = self.shapes(which)
            low[row, shapes] = high[row, shapes] = self.theta[shapes]
            low[row, list(which)] = high[row, list(which)] = self.nominal[list(which)]
        start = self.theta.expand_as(low)
        rough = torch.where(torch.isfinite(self.space.std(self.theta)), self.nominal, start)
        starts = torch.stack([start, rough], dim=1)
        refined = levenberg_marquardt(self.linearise, starts, low[:, None], high[:, None], SETTINGS)
        near = refined.converged | (refined.newton_decrement < 0.5 * CONVERGED_WITHIN**2)
        best = replace(refined, cost=torch.where(near, refined.cost, math.inf)).best()
        lowest = best.cost
        self.lowest = min([self.lowest, *lowest[torch.isfinite(lowest)].tolist()])
        fits: list[Fit | None] = []
        for row in range(len(held)):
            free = low[row] < high[row]
            fits.append(_fit_of(best, row, free) if bool(torch.isfinite(lowest[row])) else None)
        return fits

    def log_evidence(self, fit: Fit, tested: Sequence[int]) -> float:
        """Log evidence of an explanation; `evidence.log_prior` has the odds."""
        std = self.space.std(fit.theta)
        widths = torch.where(torch.isfinite(std), math.sqrt(2.0 * math.pi) * std, self.high - self.low)
        widths = torch.where(torch.isfinite(widths), widths, 1.0)
        held = held_back(fit.theta[None], fit.gradient[None], self.low[None], self.high[None])[0]
        slope = torch.where(held, fit.gradient.abs(), 0.0)[fit.free]
        volume = log_volume(fit.curvature[fit.free][:, fit.free], widths[fit.free], slope)
        places = {ParameterName.parse(self.space.names[i]).place for i in fit.present}
        return volume - fit.cost + log_prior(len(fit.present), len(places), len(tested))


def _fit_of(best: Refined, row: int, free: Tensor) -> Fit:
    return Fit(float(best.cost[row]), best.theta[row], best.gradient[row], best.curvature[row], free)


def _explanations(fits: Fits, tested: Sequence[int]) -> list[Fit]:
    """Fits with one tested fault, two ... of them, until one more fault than suffices.

    Faults that suffice are not extended. The likeliest of the others are, by each other fault.
    """
    explanations: list[Fit] = []
    candidates: list[tuple[int, ...]] = [(i,) for i in tested]
    sufficient: list[tuple[int, ...]] = []
    for _ in range(min(len(tested), MOST_FAULTS)):
        absent = [tuple(i for i in tested if i not in present) for present in candidates]
        each = zip(fits.fit(absent), candidates, absent, strict=True)
        fitted = [(replace(fit, present=present), rest) for fit, present, rest in each if fit is not None]
        explanations += [fit for fit, _ in fitted]
        if sufficient:
            break
        sufficient = [fit.present for fit, rest in fitted if not rest or fits.p_value(fit, rest) > SUFFICIENT]
        lacking = sorted((fit for fit, _ in fitted if fit.present not in sufficient), key=lambda fit: fit.cost)
        extended = {tuple(sorted({*f.present, i})) for f in lacking[:MOST_EXTENDED] for i in tested} - {*candidates}
        candidates = sorted(e for e in extended if not any({*e}.issuperset(each) for each in sufficient))
        if not candidates:
            break
    return explanations
