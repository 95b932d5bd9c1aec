"""Scales of a plant's time, length and area, rounded to a power of ten, relative to a bench-top rig.

Ranges of lags, longest steps and similar defaults are multiples of these scales, so that they suit a bench-top rig and
a water tower alike. Rounding keeps the defaults the same when a constant such as an area is estimated again.
"""

from __future__ import annotations

import math

from fdi_torch.plant.constants import flow_scale
from fdi_torch.plant.description import PlantDescription

_BENCH_EMPTYING, _BENCH_HEIGHT, _BENCH_AREA = (
    100.0,
    0.5,
    0.01,
)  # s, m, m^2; these have scale 1


def time_scale(plant: PlantDescription) -> float:
    """Time scale of the plant, s; 1 s for tanks that empty in about 100 s (A H over the outflow of the full tank)."""
    return _power_of_ten([t.area * t.height / flow_scale(plant, t.name) for t in plant.tanks], _BENCH_EMPTYING)


def length_scale(plant: PlantDescription) -> float:
    """Length scale of the plant, m; 1 m for tanks about 0.5 m high."""
    return _power_of_ten([tank.height for tank in plant.tanks], _BENCH_HEIGHT)


def area_scale(plant: PlantDescription) -> float:
    """Area scale of the plant, m^2; 1 m^2 for tanks of about 100 cm^2."""
    return _power_of_ten([tank.area for tank in plant.tanks], _BENCH_AREA)


def _power_of_ten(values: list[float], reference: float) -> float:
    """The power of ten nearest to the geometric mean of values / reference."""
    return 10.0 ** round(sum(math.log10(value / reference) for value in values) / len(values))
