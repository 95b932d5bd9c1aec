"""Laplace's evidence: what an explanation's parameters cost, what is believed before the data, and the posterior.

    log E = -cost + log of the volume of the posterior over that of the prior + log prior odds

(MacKay, 2003, "Information theory, inference and learning algorithms", chapter 28.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Odds:
    """What is believed before the data.

    effect: odds that one more thing of the library is wrong, shared by all effects at all places. same_place: odds that
    two effects sit at one place and are not one of another equation. unknown: odds that a place has a law which the
    library lacks, shared by all places. discrepancy: how far the true law of an effect may differ from the library's,
    as a share of what the effect does to the readings.
    """

    effect: float = 0.1
    same_place: float = 1e-4
    unknown: float = 0.02
    discrepancy: float = 0.15


ODDS = Odds()
RARE = 0.02  # odds against the best explanation at which what was not looked at is left alone


def log_prior(count: int, places: int, choices: int) -> float:
    """Of a set of `count` effects at so many different places, out of so many choices of an effect at a place."""
    each = count * (math.log(ODDS.effect) - math.log(choices)) + (count - places) * math.log(ODDS.same_place)
    return each + math.lgamma(count + 1)


def log_det(curvature: Tensor) -> float:
    """Of a curvature in units of each parameter's range; what the data do not show counts as known to 1 range."""
    return float(torch.log(torch.clamp(torch.linalg.eigvalsh(curvature), min=1.0)).sum())


def log_volume(curvature: Tensor, width: Tensor) -> float:
    """Log of the volume of the posterior over that of a uniform prior of these widths (P,); never above 0.

    curvature (P, P): of the cost, half a chi-square. What the data do not show keeps its prior.
    """
    scaled = curvature * width[:, None] * width[None, :] / (2.0 * math.pi)
    return -0.5 * log_det(0.5 * (scaled + scaled.mT))


def posterior(log_weights: Sequence[float]) -> list[float]:
    weights = torch.softmax(torch.tensor(log_weights, dtype=torch.float64), dim=0)
    return [float(w) for w in weights]
