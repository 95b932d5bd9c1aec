"""Diagnoses to compare with: two without skill, so that a score has something to stand beside."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from fdi_torch.blind.places import effect_places
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

Diagnosis = Callable[..., dict[str, Any]]


def always_null(plant: PlantDescription, recording: Recording, holdout: Recording, **options: Any) -> dict[str, Any]:
    """Always answers that there is no gap."""
    return {"verdict": "no_gap", "where": [], "causes": [], "ambiguity_set": [], "posterior": []}


def random_pair(seed: int) -> Diagnosis:
    """Names a random effect and location; the same for the same recording."""

    def diagnose(plant: PlantDescription, recording: Recording, holdout: Recording, **options: Any) -> dict[str, Any]:
        pairs = effect_places(plant)
        rng = np.random.default_rng([seed, zlib.crc32(recording.sha256.encode())])
        effect, place = pairs[int(rng.integers(len(pairs)))]
        cause = {"effect": effect, "location": place}
        return {"verdict": "named", "where": [{"location": place, "share": 1.0}], "causes": [cause]} | {
            "ambiguity_set": [[cause]],
            "posterior": [{"causes": [cause], "probability": 1.0}],
        }

    return diagnose
