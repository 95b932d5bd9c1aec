"""Where: how much of the gap a free discrepancy of each component alone could close, no library asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Candidate, Fit, Fitter
from fdi_torch.gap.freeform import HARMONICS, UNIT, free_form
from fdi_torch.gap.screening import Option, against, effect_columns, options_of
from fdi_torch.plant.reach import Reach

AMPLITUDES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
FINER = 4  # times finer than the recording's own frequencies
SURROUNDINGS = 15  # of the recording's own frequencies, to each side
CYCLES = 8  # that a line has to go through
STANDS_OUT = 30.0  # times the median of its surroundings; chance alone makes 10 of some thousand frequencies


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
    """All places, the likeliest first. Where the residual has a line in its spectrum, a place may also come and go in
    its period; waves: whether line or not, in the strongest period.
    """
    stands_out = 0.0 if waves else STANDS_OUT
    line = spectral_line(fitter.white(fit.near)[0][0], _spacing(fitter), stands_out)
    periods = tuple(line / k for k in range(1, HARMONICS + 1)) if line else ()
    options = [options_of(free_form(p, fitter.subject.plant, reach, periods), fitter, reach) for p in places]
    columns = effect_columns(fitter, fit, [o for own in options for o in own]) / UNIT
    found, first = [], 0
    for place, own in zip(places, options, strict=True):
        theirs = columns[..., first : first + len(own)]
        first += len(own)
        found.append(_suspect(fitter, fit, place, own, theirs, heat, periods))
    return sorted(found, key=lambda s: -s.evidence)


def _spacing(fitter: Fitter) -> float:
    return float(torch.median(torch.diff(fitter.subject.recording.time)))


def spectral_line(white: Tensor, spacing: float, stands_out: float = STANDS_OUT) -> float | None:
    """The period (s) of what stands out of its surroundings in the spectrum of a residual (S, C), if anything does."""
    samples = len(white)
    taper = torch.hann_window(samples, periodic=False, dtype=white.dtype).unsqueeze(-1)
    power = (torch.fft.rfft(white * taper, n=FINER * samples, dim=0).abs() ** 2).sum(dim=-1)
    if len(power) < 2 * SURROUNDINGS * FINER:
        return None
    width = 2 * SURROUNDINGS * FINER + 1
    around = torch.nn.functional.pad(power.reshape(1, 1, -1), (width // 2, width // 2), mode="reflect")[0, 0]
    median = around.unfold(0, width, FINER)[:, ::FINER].median(dim=-1).values
    ratio = power / median.repeat_interleave(FINER)[: len(power)]
    ratio[: CYCLES * FINER] = 0.0
    peak = int(ratio.argmax())
    return FINER * samples * spacing / peak if float(ratio[peak]) > stands_out else None


def _suspect(
    fitter: Fitter,
    fit: Fit,
    place: str,
    options: Sequence[Option],
    columns: Tensor,
    heat: float,
    periods: tuple[float, ...],
) -> Suspect:
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
