"""Candidates that extend a fit by one effect or a pair, with starts and expected gains from a screening."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from fdi_torch.gap.candidate import Candidate, Fit, Key
from fdi_torch.gap.screening import Option, Pairs, ScreeningResult
from fdi_torch.parameters import Parameter

PRIOR_GAIN = 3.0  # nats; gain at which an effect with odds of one in twenty becomes likely


@dataclass(frozen=True)
class ExpectedGain:
    """A candidate with its expected gain in log-likelihood (nats), and the log prior odds that it costs."""

    candidate: Candidate
    gain: float
    prior: float


def size_of(option: Option) -> tuple[str, float, Parameter]:
    """Full name, start value and description of an option's size."""
    name, start = next(iter(option.start.items()))
    return name, start, next(p for p in option.parameters if option.placement.full_name(p.name) == name)


def log_prior_width(screening: ScreeningResult, i: int) -> float:
    """Cost of the size of an option with a uniform prior: log of its range in standard errors."""
    _, start, size = size_of(screening.options[i])
    width, unit = size.high - size.low, abs(start - size.nominal)
    if not math.isfinite(width) or unit == 0.0:
        return 0.0
    strength = float(screening.strength[i])
    return 0.5 * math.log(max(strength * (width / unit) ** 2 / (2.0 * math.pi), 1.0))


def extended(fit: Fit, screening: ScreeningResult, group: Sequence[int]) -> Candidate:
    """The fit extended by one effect; each start has the size that the screening suggests."""
    starts = [fit.effect_values | sized(screening.options[i], float(screening.size[i])) for i in group]
    return Candidate((*fit.candidate.placements, screening.options[group[0]].placement), tuple(starts))


def sized(option: Option, factor: float) -> dict[str, float]:
    """The start with its size multiplied within bounds; that of a threshold stays."""
    if not option.placement.effect.smooth:
        return dict(option.start)
    name, start, size = size_of(option)
    value = size.nominal + min(max(factor, 0.1), 4.0) * (start - size.nominal)
    return {**option.start, name: min(max(value, size.low), size.high)}


def best_pairs(pairs: Pairs, count: int) -> list[Candidate]:
    """The pairs of different effects with the largest joint gain; each alone may gain little."""
    gain = pairs.gain()
    best: dict[Key, tuple[int, int]] = {}
    order = torch.argsort(gain.flatten(), descending=True)[:400].tolist()
    for flat in order:
        i, j = divmod(flat, gain.shape[1])
        a, b = pairs.options[i], pairs.options[j]
        if a.cause != b.cause:
            best.setdefault(frozenset((a.cause, b.cause)), (i, j))
    return [
        Candidate((pairs.options[i].placement, pairs.options[j].placement), (_joint_start(pairs, i, j),))
        for i, j in list(best.values())[:count]
    ]


def _joint_start(pairs: Pairs, i: int, j: int) -> dict[str, float]:
    pick = torch.tensor([i, j])
    # The last bits of `torch.linalg.lstsq` depend on where its arguments lie in memory.
    sizes = (torch.linalg.pinv(pairs.gram[pick][:, pick], hermitian=True) @ pairs.score[pick]).tolist()
    return sized(pairs.options[i], sizes[0]) | sized(pairs.options[j], sizes[1])


def gain_ratio(gains: Sequence[tuple[float, float]]) -> float:
    """Actual over first-order gain by least squares, at least one.

    Fits gain more than the first-order estimate because the estimated noise shrinks. One prior observation gained
    PRIOR_GAIN nats as expected.
    """
    covariance = PRIOR_GAIN**2 + sum(actual * expected for actual, expected in gains)
    return max(1.0, covariance / (PRIOR_GAIN**2 + sum(expected**2 for _, expected in gains)))
