"""Where: how much of the gap a free discrepancy of each component alone could close, no library asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Candidate, Fit, Fitter
from fdi_torch.gap.freeform import HARMONICS, UNIT, free_form, waves_at
from fdi_torch.gap.screening import against, effect_columns, options_of
from fdi_torch.plant.reach import Reach

AMPLITUDES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
PERIODS = tuple(15.0 * 1.05**k for k in range(80))  # s: 15 s to 12 min, near enough for some ten cycles


@dataclass(frozen=True)
class Suspect:
    """closes: chi-square units that the place's free discrepancy takes away, to first order. evidence: its log Bayes
    factor against the recalibrated plant at its best amplitude. periods: of its sines, s."""

    location: str
    closes: float
    evidence: float
    periods: tuple[float, ...] = ()


def suspects(
    fitter: Fitter, fit: Fit, places: Sequence[str], reach: Reach, heat: float, waves: bool = False
) -> list[Suspect]:
    """All places, the likeliest first. waves: also look for what comes and goes by itself."""
    found = []
    for place in places:
        periods = _periods(fitter, fit, place, reach) if waves else ()
        found.append(_suspect(fitter, fit, place, reach, heat, periods))
    return sorted(found, key=lambda s: -s.evidence)


def _periods(fitter: Fitter, fit: Fit, place: str, reach: Reach) -> tuple[float, ...]:
    """The period whose sine and cosine close most, and its first overtones."""
    possible = [p for p in PERIODS if p < 0.25 * reach.duration]
    placement = waves_at(place, fitter.subject.plant, reach, possible)
    options = options_of([placement], fitter, reach)
    found = against(fitter, fit, options, effect_columns(fitter, fit, options))
    gains = []
    for j in range(len(possible)):
        pair = slice(2 * j, 2 * j + 2)
        gram = found.gram[pair, pair] + 1e-9 * found.gram[pair, pair].diagonal().max() * torch.eye(2)
        gains.append(float(found.score[pair] @ torch.linalg.solve(gram, found.score[pair])))
    best = possible[max(range(len(gains)), key=gains.__getitem__)]
    return tuple(best / k for k in range(1, HARMONICS + 1))


def _suspect(fitter: Fitter, fit: Fit, place: str, reach: Reach, heat: float, periods: tuple[float, ...]) -> Suspect:
    options = options_of(free_form(place, fitter.subject.plant, reach, periods), fitter, reach)
    columns = effect_columns(fitter, fit, options) / UNIT
    prior = torch.tensor([o.parameters[0].std for o in options], dtype=columns.dtype)
    found = against(fitter, fit, options, columns * prior)
    spectrum, basis = torch.linalg.eigh(found.gram / heat)
    spectrum, score = spectrum.clamp(min=0.0), basis.T @ found.score / heat
    evidence, closes = max((_marginal(spectrum, score, a) for a in AMPLITUDES), key=lambda m: m[0])
    return Suspect(place, closes * heat, evidence, periods)


def _marginal(spectrum: Tensor, score: Tensor, amplitude: float) -> tuple[float, float]:
    """Log Bayes factor of coefficients ~ N(0, amplitude^2), and the chi-square that their mean closes."""
    v = amplitude**2
    shrunk = score / (spectrum + 1.0 / v)
    evidence = 0.5 * float((score * shrunk).sum()) - 0.5 * float(torch.log1p(v * spectrum).sum())
    closes = float((2.0 * score * shrunk - spectrum * shrunk**2).sum())
    return evidence, closes


def refit(fitter: Fitter, fit: Fit, suspect: Suspect, reach: Reach, rounds: int = 16) -> Fit:
    """The free discrepancy of one place fitted in full, about the moving trajectory."""
    plant = fitter.subject.plant
    placements = free_form(suspect.location, plant, reach, suspect.periods)
    start = {f"{p.prefix}.{c.name}": 0.0 for p in placements for c in p.effect.parameters(p.location, plant)}
    return fitter.fit(Candidate(placements, (start,)), fit, rounds=rounds)
