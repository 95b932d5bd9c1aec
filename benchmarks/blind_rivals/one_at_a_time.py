"""Baseline for comparison: every effect alone, white noise, the lowest BIC wins.

    BIC = n log(RSS / n) + k log n        (Schwarz, 1978)

for n readings, each divided by the standard deviation of its channel's residual, and k parameters besides the
recalibrated ones. It considers neither pairs nor correlated noise nor unknown causes, and states no uncertainty.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from fdi_torch.effects import effect
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.library import library_of
from fdi_torch.gap.screening import Option, ScreeningResult, options_of, screen
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.operating_range import operating_range_of
from fdi_torch.recording import Recording

FITTED, STARTS = 14, 2


def one_at_a_time(
    plant: PlantDescription,
    recording: Recording,
    library: tuple[str, ...] | None = None,
    leave_out: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Fit the most promising effects one by one and return an answer in the format of a diagnosis."""
    placements = library_of(plant, library, leave_out)
    nominal_effects = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    step = recording.interval
    data = data_set_of(plant, nominal_effects, recording, step)
    spread = data.readings.nan_to_num().std(dim=0).clamp(min=1e-9)
    null = Fitter(data, _white(1e-2 * spread)).fit(Candidate())
    residual = torch.where(data.mask, data.readings - null.linearised.readings[0], 0.0)
    fitter = Fitter(data, _white(residual.std(dim=0).clamp(min=1e-12)))
    null = fitter.fit(Candidate(), null)
    options = options_of(
        [p for p in placements if not p.effect.quantizes], fitter, operating_range_of(recording, plant)
    )
    fits = [null, *(fitter.fit(c, null) for c in _singles(screen(fitter, null, options)))]
    winner = min(fits, key=lambda fit: _bic(fitter, fit))
    return _named([(p.effect.name, p.location) for p in winner.candidate.placements])


def _white(std: torch.Tensor) -> Noise:
    return Noise(std, torch.zeros_like(std))


def _singles(screened: ScreeningResult) -> list[Candidate]:
    """The most promising effects, each with its best starts."""
    by_cause: dict[CauseName, list[Option]] = {}
    for i in torch.argsort(screened.gain, descending=True).tolist():
        by_cause.setdefault(screened.options[i].cause, []).append(screened.options[i])
    return [
        Candidate((options[0].placement,), tuple(o.start for o in options[:STARTS]))
        for options in list(by_cause.values())[:FITTED]
    ]


def _bic(fitter: Fitter, fit: Fit) -> float:
    n = float(fitter.data.mask.sum())
    return n * math.log(fit.cost / n) + len(fit.effect_values) * math.log(n)


def _named(causes: list[CauseName]) -> dict[str, Any]:
    listed = [{"effect": name, "location": place} for name, place in causes]
    return {
        "verdict": "named" if causes else "no_gap",
        "where": [{"location": place, "share": 1.0} for _, place in causes],
        "causes": listed,
        "ambiguity_set": [listed] if causes else [],
        "posterior": [{"causes": listed, "probability": 1.0}],
    }
