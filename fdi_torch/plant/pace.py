"""How fast and how large a plant is, to the nearest power of ten: what times and lengths are short and long for it.

Ranges of lags, longest steps and the like are multiples of these, so that they mean the same on a bench and on a water
tower. Powers of ten, because a range is an order of magnitude: an area that is estimated anew does not move it.
"""

from __future__ import annotations

import math

from fdi_torch.plant.constants import flow_scale
from fdi_torch.plant.description import PlantDescription

_USUAL_EMPTYING, _USUAL_HEIGHT, _USUAL_AREA = 100.0, 0.5, 0.01  # s, m, m^2: of tanks on a bench, whose scales are 1


def time_scale(plant: PlantDescription) -> float:
    """1 s for tanks that empty in about 100 s: V / q, q what leaves a full tank through its leak reference."""
    return _power_of_ten([t.area * t.height / flow_scale(plant, t.name) for t in plant.tanks], _USUAL_EMPTYING)


def length_scale(plant: PlantDescription) -> float:
    """1 m for tanks about half a metre high."""
    return _power_of_ten([tank.height for tank in plant.tanks], _USUAL_HEIGHT)


def area_scale(plant: PlantDescription) -> float:
    """1 m^2 for tanks of about 100 cm^2."""
    return _power_of_ten([tank.area for tank in plant.tanks], _USUAL_AREA)


def _power_of_ten(values: list[float], usual: float) -> float:
    """The power of ten next to the geometric mean of values / usual."""
    return 10.0 ** round(sum(math.log10(value / usual) for value in values) / len(values))
