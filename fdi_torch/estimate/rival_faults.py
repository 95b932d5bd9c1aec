"""Rival faults: suspected faults of which at least one is present although the readings do not tell which.

Faults that act alike have large standard errors, so that none of them differs from nominal alone, however certain it is
that one is present. The joint test of a set R of faults compares the estimate with the best fit without them,

    Lambda = 2 (min over theta with theta_R nominal of f(theta) - min f(theta)),

with f the negative log-likelihood, priors included. Without a fault, Lambda has a chi-square distribution with |R|
degrees of freedom (Wilks 1938, Annals of Mathematical Statistics 9:60). It is smaller if a nominal size is an end of its
range (Self and Liang 1987), so that the test is then conservative. The threshold also holds for each subset of R
(Scheffe 1953, Biometrika 40:87).

Each subset S of R is then an explanation, in which the other faults of R are nominal. Its probability follows from the
evidence of `estimate.evidence`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from fdi_torch.amounts import estimate_words, parameter_words, probability_words, sized_words
from fdi_torch.estimate.evidence import log_prior, log_volume, posterior
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import Linearise, Refined, held_back
from fdi_torch.estimate.refinement import CONVERGED_WITHIN, TIGHT_DECREASE
from fdi_torch.names import listed
from fdi_torch.parameters import ParameterName, ParameterSpace

SETTINGS = RefineSettings(iterations=200, decrease_tolerance=TIGHT_DECREASE)
LEAST_PROBABILITY, LEAST_LISTED = 0.01, 2
"""Explanations below this probability are not listed, but at least so many."""
SUFFICIENT = 0.05
"""Faults suffice if one more fault lowers the misfit by no more than chance does with this probability."""
MOST_EXTENDED = 8
"""The likeliest explanations of one number of faults that are extended by one more."""
MOST_FAULTS = 4
"""The largest number of faults in one explanation."""


@dataclass(frozen=True)
class Explanation:
    """Faults that together explain the readings, the other rivals being nominal, with sizes and standard errors (SI).

    No names: no rival is present. probability: among all explanations.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    value: tuple[float, ...]
    std: tuple[float, ...]
    probability: float

    @property
    def sentence(self) -> str:
        """'leak at A (size 0.197 ± 0.015) explains the readings: probability 97.0 %'."""
        each = zip(self.names, self.units, self.value, self.std, strict=True)
        faults = [sized_words(n, [estimate_words(n, unit, value, std)]) for n, unit, value, std in each]
        verb = "explains" if len(faults) == 1 else "explain"
        subject = f"{listed(faults)}{' alone' if len(faults) == 1 else ' together'}" if faults else "none of them"
        verb = verb if faults else "is present"
        return f"{subject} {verb}{' the readings' if faults else ''}: probability {probability_words(self.probability)}"

    @property
    def words(self) -> str:
        """'leak at A: 97.0 %'."""
        faults = listed([parameter_words(name) for name in self.names]) or "none"
        return f"{faults}: {probability_words(self.probability)}"


@dataclass(frozen=True)
class RivalFaults:
    """Faults of which at least one is present. chi_square: Lambda of `names`. probability: confidence level at which
    they differ from nominal together. explanations: the likeliest first.
    """

    names: tuple[str, ...]
    chi_square: float
    probability: float
    explanations: tuple[Explanation, ...]

    @property
    def rivals(self) -> str:
        """'leak at A, leak at B or plugging at link'."""
        return listed([parameter_words(name) for name in self.names], "or")

    @property
    def sized_rivals(self) -> str:
        """The rivals with the probabilities of the explanations."""
        return f"{self.rivals} ({'; '.join(e.words for e in self.explanations)})"

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is known of them, one sentence each."""
        first = f"at least one of them is present, with a confidence of {probability_words(self.probability)}"
        why = "none differs significantly from nominal alone, because the readings hardly distinguish them"
        return first, why, *(explanation.sentence for explanation in self.explanations)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> RivalFaults:
        """The rivals of `to_dict`. Raises KeyError, TypeError or ValueError for anything else."""
        explanations = []
        for each in plain["explanations"]:
            names, units = (tuple(map(str, each[key])) for key in ("names", "units"))
            value, std = (tuple(map(float, each[key])) for key in ("value", "std"))
            if not len(names) == len(units) == len(value) == len(std):
                raise ValueError(f"expected a unit, a value and an error for each of {len(names)} faults")
            explanations.append(Explanation(names, units, value, std, float(each["probability"])))
        chi_square, probability = (float(plain[key]) for key in ("chi_square", "probability"))
        return cls(tuple(map(str, plain["names"])), chi_square, probability, tuple(explanations))


def rival_faults(
    linearise: Linearise, space: ParameterSpace, theta: Tensor, tested: Sequence[int], level: float
) -> RivalFaults | None:
    """The rivals among the faults `tested` (indices into `space`), None unless they differ from nominal together.

    linearise: of the negative log-likelihood with known noise. theta (P,): the estimate. level: confidence level.
    """
    fits = _Fits(linearise, space, theta)
    without = fits.fit([tuple(tested)])[0]
    if without is None or fits.p_value(without, len(tested)) >= 1.0 - level:
        return None
    explanations = _explanations(fits, tested)
    weights = posterior([fits.log_evidence(e, tested) for e in explanations])
    ranked = sorted(zip(explanations, weights, strict=True), key=lambda pair: -pair[1])
    listed_ones = [pair for k, pair in enumerate(ranked) if k < LEAST_LISTED or pair[1] >= LEAST_PROBABILITY]
    rivals = tuple(i for i in tested if any(i in e.present for e, _ in listed_ones))
    subset = fits.fit([rivals])[0]
    if subset is None or fits.p_value(subset, len(tested)) >= 1.0 - level:
        rivals, subset = tuple(tested), without
    return RivalFaults(
        tuple(space.names[i] for i in rivals),
        fits.ratio(subset),
        1.0 - fits.p_value(subset, len(tested)),
        tuple(e.described(space, w) for e, w in listed_ones),
    )


@dataclass(frozen=True)
class _Fit:
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


class _Fits:
    """Fits from an estimate, with some faults held at their nominal sizes."""

    def __init__(self, linearise: Linearise, space: ParameterSpace, theta: Tensor) -> None:
        self.linearise, self.space, self.theta = linearise, space, theta
        self.low, self.high, self.nominal = (x.to(theta) for x in (space.low(), space.high(), space.nominal()))
        self.lowest = float(linearise(theta[None], torch.zeros(1, dtype=torch.int64)).cost)

    def ratio(self, fit: _Fit) -> float:
        """Likelihood ratio of a fit against the best one."""
        return max(2.0 * (fit.cost - self.lowest), 0.0)

    def p_value(self, fit: _Fit, degrees: int) -> float:
        """Probability of such a ratio by chance, of chi-square with `degrees` degrees of freedom."""
        half = torch.tensor([0.5 * degrees, 0.5 * self.ratio(fit)], dtype=torch.float64)
        return float(torch.special.gammaincc(half[0], half[1]))

    def fit(self, held: Sequence[tuple[int, ...]]) -> list[_Fit | None]:
        """The best fits with these parameters nominal, from two starts each: the estimate, and its deviations without
        those of tested faults. None for one that did not converge."""
        low, high = self.low.repeat(len(held), 1), self.high.repeat(len(held), 1)
        for row, which in enumerate(held):
            low[row, list(which)] = high[row, list(which)] = self.nominal[list(which)]
        start = self.theta.expand_as(low)
        rough = torch.where(torch.isfinite(self.space.std(self.theta)), self.nominal, start)
        starts = torch.stack([start, rough], dim=1)
        refined = levenberg_marquardt(self.linearise, starts, low[:, None], high[:, None], SETTINGS)
        near = refined.converged | (refined.newton_decrement < 0.5 * CONVERGED_WITHIN**2)
        best = replace(refined, cost=torch.where(near, refined.cost, math.inf)).best()
        lowest = best.cost
        self.lowest = min([self.lowest, *lowest[torch.isfinite(lowest)].tolist()])
        fits: list[_Fit | None] = []
        for row in range(len(held)):
            free = low[row] < high[row]
            fits.append(_fit_of(best, row, free) if bool(torch.isfinite(lowest[row])) else None)
        return fits

    def log_evidence(self, fit: _Fit, tested: Sequence[int]) -> float:
        """Log evidence of an explanation; `evidence.log_prior` has the odds."""
        std = self.space.std(fit.theta)
        widths = torch.where(torch.isfinite(std), math.sqrt(2.0 * math.pi) * std, self.high - self.low)
        widths = torch.where(torch.isfinite(widths), widths, 1.0)
        held = held_back(fit.theta[None], fit.gradient[None], self.low[None], self.high[None])[0]
        slope = torch.where(held, fit.gradient.abs(), 0.0)[fit.free]
        volume = log_volume(fit.curvature[fit.free][:, fit.free], widths[fit.free], slope)
        places = {ParameterName.parse(self.space.names[i]).place for i in fit.present}
        return volume - fit.cost + log_prior(len(fit.present), len(places), len(tested))


def _fit_of(best: Refined, row: int, free: Tensor) -> _Fit:
    return _Fit(float(best.cost[row]), best.theta[row], best.gradient[row], best.curvature[row], free)


def _explanations(fits: _Fits, tested: Sequence[int]) -> list[_Fit]:
    """Fits with no tested fault, one, two ... of them, until one more fault than suffices.

    Of each number, the likeliest ones are extended by each other fault.
    """
    explained: list[_Fit] = []
    candidates: list[tuple[int, ...]] = [()]
    sufficient = False
    for count in range(min(len(tested), MOST_FAULTS) + 1):
        held = [tuple(i for i in tested if i not in present) for present in candidates]
        of_count = [
            replace(fit, present=present)
            for fit, present in zip(fits.fit(held), candidates, strict=True)
            if fit is not None
        ]
        explained += of_count
        if sufficient:
            break
        rest = len(tested) - count
        sufficient = not rest or any(fits.p_value(fit, rest) > SUFFICIENT for fit in of_count)
        likeliest = sorted(of_count, key=lambda fit: fit.cost)[:MOST_EXTENDED]
        extended = {tuple(sorted({*fit.present, i})) for fit in likeliest for i in tested if i not in fit.present}
        candidates = sorted(extended)
        if not candidates:
            break
    return explained
