"""Onset times from which fits under random flows start.

Under sensor noise alone the cost has a wide minimum about an onset, and a coarse grid of starts suffices. Random flows
with a long correlation time make it narrow: they explain a flow that changed some time ago. A random flow of standard
deviation q into a tank of area A moves the level by q t / A within a time t, and the mean of the readings until then
has the standard error s sqrt(dt / t). Both are equal after

    t = (s A sqrt(dt) / q)^(2/3)

The readings show a random flow after this time t, so the minimum about an onset is a few t wide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.screening import Option

SPACING = 4.0  # times t; no onset is further than 2 t from a start, where most of its gain is left
INSTANTS = ("onset", "begin")  # names of parameters that are onset times
MOST = 127  # onset times, a limit on computing time


def fine_onsets(options: Sequence[Option], fitter: Fitter) -> list[Option]:
    """Further onset times of these options, as dense as the random flows in the fitter's noise require."""
    duration = max(float(part.experiment.nodes[-1]) for part in fitter.data.parts)
    count = min(math.ceil(duration / (SPACING * detection_time(fitter))), MOST)
    further: list[Option] = []
    coarse: dict[tuple[str, tuple[str, str], tuple[tuple[str, float], ...]], list[Option]] = {}
    for option in options:
        for onset in (f"{option.placement.prefix}.{name}" for name in INSTANTS):
            if onset in option.start:
                others = tuple((n, v) for n, v in option.start.items() if n != onset)
                coarse.setdefault((onset, option.cause, others), []).append(option)
    for (onset, *_), group in coarse.items():
        if count > len(group):
            times = [duration * (k + 1) / (count + 1) for k in range(count)]
            further += [replace(group[0], start={**group[0].start, onset: time}) for time in times]
    return further


def detection_time(fitter: Fitter) -> float:
    """The shortest time t (s) after which the readings show a random flow; infinite if these are forgotten sooner."""
    if fitter.whitening is None:
        return math.inf
    propagation, noise = fitter.whitening.propagation, fitter.whitening.noise
    areas = torch.tensor([t.area for t in fitter.data.plant.tanks], dtype=torch.float64)
    sensitivity = propagation.output.abs().amax(dim=0)[:, : len(areas)]
    std = fitter.noise.std * noise.scale
    level_noise = (std.unsqueeze(1) / sensitivity).amin(dim=0)
    shortest = float(((level_noise * areas * math.sqrt(propagation.interval) / noise.intensity) ** (2 / 3)).min())
    shortest = max(shortest, propagation.interval)
    return shortest if noise.correlation_time > shortest else math.inf
