"""Where: how much of the gap a free discrepancy of each component alone could close, no library asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Candidate, Fit, Fitter
from fdi_torch.gap.screening import against, effect_columns, options_of
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.reach import Reach

AMPLITUDES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)


@dataclass(frozen=True)
class Suspect:
    """closes: chi-square units that the place's free discrepancy takes away, to first order; evidence: its log Bayes
    factor against the recalibrated plant at heat 1, at its best amplitude."""

    location: str
    closes: float
    evidence: float


def suspects(
    fitter: Fitter, fit: Fit, forms: Mapping[str, tuple[Placement, ...]], reach: Reach, heat: float
) -> list[Suspect]:
    """All places, the likeliest first."""
    found = [_suspect(fitter, fit, place, placements, reach, heat) for place, placements in forms.items()]
    return sorted(found, key=lambda s: -s.evidence)


def _suspect(
    fitter: Fitter, fit: Fit, place: str, placements: Sequence[Placement], reach: Reach, heat: float
) -> Suspect:
    options = options_of(placements, fitter, reach)
    columns = effect_columns(fitter, fit, options) / torch.tensor([next(iter(o.start.values())) for o in options])
    prior = torch.tensor([o.parameters[0].std for o in options], dtype=columns.dtype)
    found = against(fitter, fit, options, columns * prior)
    spectrum, basis = torch.linalg.eigh(found.gram / heat)
    spectrum, score = spectrum.clamp(min=0.0), basis.T @ found.score / heat
    best = max(((*_marginal(spectrum, score, a), a) for a in AMPLITUDES), key=lambda m: m[0])
    return Suspect(place, best[1] * heat, best[0])


def _marginal(spectrum: Tensor, score: Tensor, amplitude: float) -> tuple[float, float]:
    """Log Bayes factor of coefficients ~ N(0, amplitude^2), and the chi-square that their mean closes."""
    v = amplitude**2
    shrunk = score / (spectrum + 1.0 / v)
    evidence = 0.5 * float((score * shrunk).sum()) - 0.5 * float(torch.log1p(v * spectrum).sum())
    closes = float((2.0 * score * shrunk - spectrum * shrunk**2).sum())
    return evidence, closes


def refit(fitter: Fitter, fit: Fit, placements: tuple[Placement, ...], rounds: int = 6) -> Fit:
    """The free discrepancy of one place fitted in full, about the moving trajectory."""
    start = {
        f"{p.prefix}.{c.name}": 0.0 for p in placements for c in p.effect.parameters(p.location, fitter.subject.plant)
    }
    return fitter.fit(Candidate(placements, (start,)), fit, rounds=rounds)
