"""The rig as it was built: every constant that the plant file gives a tolerance is a little off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdi_torch.plant.description import PlantDescription

WIDEST = 2.5
"""Standard deviations that a constant is off at most."""
_LEAST = 0.2


def as_built(plant: PlantDescription, rng: np.random.Generator) -> PlantDescription:
    """Constants drawn within their tolerances: x (1 + s z), an offset x + s z, z standard normal and clipped."""
    off: dict[str, dict[str, float]] = {}
    for constant, tolerance in plant.tolerances.items():
        name, _, field = constant.rpartition(".")
        z = float(np.clip(rng.normal(), -WIDEST, WIDEST))
        believed = float(getattr(plant.component(name), field))
        drawn = believed + tolerance * z if field == "offset" else believed * max(1 + tolerance * z, _LEAST)
        off.setdefault(name, {})[field] = drawn
    return replace(
        plant,
        tanks=tuple(replace(t, **off.get(t.name, {})) for t in plant.tanks),  # type: ignore[arg-type]
        pipes=tuple(replace(p, **off.get(p.name, {})) for p in plant.pipes),  # type: ignore[arg-type]
        pumps=tuple(replace(p, **off.get(p.name, {})) for p in plant.pumps),  # type: ignore[arg-type]
        sensors=tuple(replace(s, **off.get(s.name, {})) for s in plant.sensors),  # type: ignore[arg-type]
    )


def conductance(plant: PlantDescription) -> np.ndarray:
    """(P,): discharge coefficient x bore x sqrt(2 g), m^2.5/s."""
    root = np.sqrt(2 * plant.gravity)
    return np.array([p.discharge_coefficient * p.area * root for p in plant.pipes])
