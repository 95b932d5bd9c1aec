"""Bayesian evidence of a model by Laplace's approximation, prior odds of sets of effects, and posterior probabilities.

    log E = -cost + log(posterior volume / prior volume) + log prior odds

The cost is the negative log-likelihood at its minimum. The volume ratio is the Occam factor, which penalises parameters
(MacKay, 2003, "Information theory, inference and learning algorithms", chapter 28).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Odds:
    """Prior odds of deviations from the nominal model.

    effect: odds of one more effect of the library, divided equally among all effects at all places.
    same_place: factor for a second effect at the same place, as opposed to one effect with a different law.
    unknown: odds that some place follows a law that is not in the library, divided equally among all places.
    inexact: probability that the law of an effect differs noticeably from that in the library. Of 113 simulated rigs
    with one effect (seed 20261213 of the blind benchmark, not used for its scores), 7 had such a law.
    law_error: standard deviation of the relative error of such a law, as a fraction of the effect on the readings.
    """

    effect: float = 0.1
    same_place: float = 1e-4
    unknown: float = 0.02
    inexact: float = 0.06
    law_error: float = 0.06


ODDS = Odds()
TOLERANCE = 0.1  # nats; a smaller gain in log evidence ends a search
RARE = 0.02  # odds relative to the best model below which candidates that were not yet fitted are ignored


def log_prior(count: int, places: int, choices: int) -> float:
    """Log prior odds of a set of `count` effects at `places` distinct places.

    log p = count log(effect / choices) + (count - places) log(same_place) + log count!, where `choices` is the number
    of possible pairs of effect and place, and count! counts the orders in which the same set can be drawn.
    """
    each = count * (math.log(ODDS.effect) - math.log(choices)) + (count - places) * math.log(ODDS.same_place)
    return each + math.lgamma(count + 1)


def log_law_error(error: float) -> float:
    """Log probability of a noticeable relative error of a law, times its density over that of no error."""
    return math.log(ODDS.inexact) - 0.5 * (error / ODDS.law_error) ** 2


def log_odds_of_law(error: float | None, choices: int, places: int) -> float:
    """Log odds that a deviation is an effect whose law has this relative error, against a law that no library has.

    error: None if the readings cannot show an error of the law. choices: number of possible pairs of effect and place.
    places: number of places. The error of the library's law is normal. A law that no library has differs from it,
    relative to its size, by a number that is uniform between -2 and 2.
    """
    density = math.log(2.0 * 2.0 / (ODDS.law_error * math.sqrt(2.0 * math.pi)))
    law = density + (math.log1p(-ODDS.inexact) if error is None else log_law_error(error))
    return math.log(ODDS.effect / choices) - math.log(ODDS.unknown / places) + law


def log_det(curvature: Float[Tensor, "P P"]) -> float:
    """Log determinant of a curvature (P, P) that is scaled by each parameter's prior width.

    Eigenvalues below one are set to one: a direction without information in the data keeps its prior.
    """
    return float(torch.log(torch.clamp(torch.linalg.eigvalsh(curvature), min=1.0)).sum())


def log_volume(
    curvature: Float[Tensor, "P P"], width: Float[Tensor, " P"], slope: Float[Tensor, " P"] | None = None
) -> float:
    """Log of the Occam factor, the ratio of posterior volume to uniform prior volume: -log det(W H W / 2 pi) / 2 <= 0.

    curvature (P, P): Hessian H of the cost, half a chi-square. width (P,): widths of the prior, the diagonal of W. A
    direction without information in the data contributes 0. slope (P,): magnitude g of the cost's gradient for
    parameters that an end of their range holds back, 0 for the others. Such a parameter contributes the integral of
    exp(-g x - s x^2 / 2) over its distance x from that end; s is its curvature with all others integrated out.
    """
    scaled = curvature * width[:, None] * width[None, :]
    scaled = 0.5 * (scaled + scaled.mT)
    held = torch.zeros_like(width, dtype=torch.bool) if slope is None else slope > 0.0
    inside, across = scaled[~held][:, ~held], scaled[held][:, ~held]
    volume = -0.5 * log_det(inside / (2.0 * math.pi))
    if slope is None or not bool(held.any()):
        return volume
    remaining = scaled[held][:, held].diagonal() - (across @ torch.linalg.pinv(inside, hermitian=True) * across).sum(-1)
    root = (2.0 * remaining.clamp(min=1e-12)).sqrt()
    integral = math.sqrt(math.pi) / root * torch.special.erfcx(slope[held] * width[held] / root)
    return volume + float(integral.clamp(max=1.0).log().sum())


def posterior(log_weights: Sequence[float]) -> list[float]:
    """Posterior probabilities of models from their log evidences, normalised to a sum of one."""
    weights = torch.softmax(torch.tensor(log_weights, dtype=torch.float64), dim=0)
    return [float(w) for w in weights]
