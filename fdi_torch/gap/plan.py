"""Before any data: which effects a planned input can never show, and which it can never tell apart.

Each effect at its typical size moves the readings by a column of the linearised plant. What is left of a column beside
the calibration constants and start levels, over the noise, is how well the effect shows; what is left beside another
effect's column too is how well the two part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.effects import effect
from fdi_torch.gap.fitting import Candidate, Fitter, subject_of
from fdi_torch.gap.floor import Noise
from fdi_torch.gap.library import canonical, library_of
from fdi_torch.gap.screening import Option, options_of, screen
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.plant.reach import reach_of
from fdi_torch.recording import Recording

SHOWN = 25.0  # chi-square units: five standard errors
PARTED = 25.0


@dataclass(frozen=True)
class Plan:
    """hidden: causes that do not show at their typical size. twins: pairs that do not part, with what parts them in
    chi-square units; shown: how well each shows, in the same units."""

    hidden: tuple[tuple[str, str], ...]
    twins: tuple[tuple[tuple[str, str], tuple[str, str], float], ...]
    shown: dict[str, float]


def plan(plant: PlantDescription, recording: Recording, noise: float, library: Sequence[str] | None = None) -> Plan:
    """recording: planned inputs; what was read, if anything, is not looked at. noise: std of a reading, its unit."""
    believed = [Placement(effect(p.effect), p.location, p.parameters) for p in plant.effects]
    step = float(torch.median(torch.diff(recording.time)))
    fitter = _noise_free(plant, believed, recording, step, noise)
    null = fitter.fit(Candidate())
    seen = replace(fitter.subject.recording, outputs=null.near.readings[0])
    placements = [p for p in library_of(plant, library) if not p.effect.rounds]
    options = options_of(placements, fitter, reach_of(seen, plant))
    found = screen(fitter, null, options)
    strength = torch.diagonal(found.gram)
    best = _strongest(options, strength)
    shown = {f"{place}.{name}": float(strength[i]) for (name, place), i in best.items()}
    hidden = tuple(cause for cause, i in best.items() if float(strength[i]) < SHOWN)
    return Plan(hidden, _twins(plant, best, found.gram), shown)


def _noise_free(
    plant: PlantDescription, believed: Sequence[Placement], recording: Recording, step: float, noise: float
) -> Fitter:
    """A fitter whose readings are what the plant file predicts, from its start levels or from rest."""
    sensors = len(plant.sensors)
    names = tuple(s.column for s in plant.sensors)
    units = tuple(s.unit for s in plant.sensors)
    blank = torch.zeros(len(recording), sensors, dtype=torch.float64)
    planned = replace(
        recording, outputs=blank, output_names=names, output_units=units, mask=torch.ones_like(blank, dtype=torch.bool)
    )
    subject = subject_of(plant, believed, planned, step)
    white = Noise(torch.full((sensors,), noise, dtype=torch.float64), torch.zeros(sensors, dtype=torch.float64))
    engine = Fitter(subject, white).engine(Candidate(), ())
    theta = engine.space.nominal().unsqueeze(0)
    readings = engine.settle(theta, engine.constant_guess(theta), rounds=30).readings[0]
    return Fitter(replace(subject, readings=readings, recording=replace(planned, outputs=readings)), white)


def _strongest(options: Sequence[Option], strength: Tensor) -> dict[tuple[str, str], int]:
    """The start of each cause that shows most."""
    best: dict[tuple[str, str], int] = {}
    for i, option in enumerate(options):
        if option.cause not in best or strength[i] > strength[best[option.cause]]:
            best[option.cause] = i
    return best


def _twins(
    plant: PlantDescription, best: dict[tuple[str, str], int], gram: Tensor
) -> tuple[tuple[tuple[str, str], tuple[str, str], float], ...]:
    """Pairs of causes that show, of which one at any size leaves too little of the other."""
    causes = [c for c, i in best.items() if float(gram[i, i]) >= SHOWN]
    found = []
    for k, a in enumerate(causes):
        for b in causes[k + 1 :]:
            i, j = best[a], best[b]
            weaker = min(float(gram[i, i]), float(gram[j, j]))
            left = weaker * (1.0 - float(gram[i, j]) ** 2 / (float(gram[i, i]) * float(gram[j, j])))
            if left < PARTED and canonical(a, plant) != canonical(b, plant):
                found.append((a, b, max(left, 0.0)))
    return tuple(sorted(found, key=lambda pair: pair[2]))
