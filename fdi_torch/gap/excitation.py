"""What an excitation can never show and never tell apart, whatever the readings turn out to be.

Each effect at its typical size moves the readings by a column of the linearised plant. What is left of it beside the
calibration constants and start levels, over the noise, is how well the effect shows; what is left beside another
effect's column too is how well the two part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.library import canonical
from fdi_torch.gap.screening import Option, Screen
from fdi_torch.plant.description import PlantDescription

SHOWN = 25.0  # chi-square units: five standard errors
PARTED = 25.0


@dataclass(frozen=True)
class Excitation:
    """hidden: causes that do not show at their typical size. twins: pairs that do not part, with what parts them in
    chi-square units, the closest first; shown: how well each shows, in the same units."""

    hidden: tuple[CauseName, ...]
    twins: tuple[tuple[CauseName, CauseName, float], ...]
    shown: Mapping[CauseName, float]


def excitation(found: Screen, plant: PlantDescription) -> Excitation:
    """From the screen of a library beside the nuisances."""
    pairs = found.pairs
    strength = torch.diagonal(pairs.gram)
    best = _strongest(pairs.options, strength)
    hidden = tuple(cause for cause, i in best.items() if float(strength[i]) < SHOWN)
    return Excitation(hidden, _twins(plant, best, pairs.gram), {c: float(strength[i]) for c, i in best.items()})


def _strongest(options: Sequence[Option], strength: Tensor) -> dict[CauseName, int]:
    """The start of each cause that shows most."""
    best: dict[CauseName, int] = {}
    for i, option in enumerate(options):
        if option.cause not in best or strength[i] > strength[best[option.cause]]:
            best[option.cause] = i
    return best


def _twins(
    plant: PlantDescription, best: Mapping[CauseName, int], gram: Tensor
) -> tuple[tuple[CauseName, CauseName, float], ...]:
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
