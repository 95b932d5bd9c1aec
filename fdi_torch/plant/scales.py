"""Scales of a plant's time and length, relative to the three-tank rig of the 2020 paper.

Ranges of lags, longest steps and similar defaults are stated for that rig and multiplied by these scales, so that they
suit a beaker and a water tower alike. The scales follow from dynamic similarity: a plant whose lengths and times are
multiplied by two factors has scales multiplied by these factors, and everything else follows.
"""

from __future__ import annotations

import math
from statistics import geometric_mean

from fdi_torch.plant.constants import flow_scale, nominal_capacity
from fdi_torch.plant.description import PlantDescription, Tank
from fdi_torch.quantities import display_unit, significant, unit_factor, volume_unit
from fdi_torch.tables import Table

# Height, m, and emptying time A H / (C_d a sqrt(2 g H)), s, of the tanks of three_tank.
_HEIGHT = 1.0
_EMPTYING_TIME = 0.016 * _HEIGHT / (0.6 * 0.6e-4 * math.sqrt(2.0 * 9.81))


def tank_table(plant: PlantDescription) -> Table:
    """Size and emptying time of each tank, in the units for display."""
    (area, per_area), (height, per_height), volume = display_unit("m^2"), display_unit("m"), volume_unit()
    per_volume = 1.0 / unit_factor(volume, "m^3")
    rows = []
    for tank in plant.tanks:
        sizes = (per_area * tank.area, per_height * tank.height, per_volume * tank.area * tank.height)
        time = emptying_time(plant, tank)
        rows.append([tank.name, *sizes, significant(time, 3) if math.isfinite(time) else "never"])
    sizes_in = (f"area, {area}", f"height, {height}", f"volume, {volume}")
    return Table(("tank", *sizes_in, "empties from full in, s"), rows, digits=4)


def emptying_time(plant: PlantDescription, tank: Tank) -> float:
    """Time in which a full tank empties through all pipes that leave it, s: 2 A H / (C sqrt(H)) by Torricelli's law.

    Infinite for a tank that no pipe leaves. Elevations of orifices and levels behind them are neglected.
    """
    capacity = sum(nominal_capacity(plant, pipe) for pipe in plant.pipes if pipe.source == tank.name)
    return 2.0 * tank.area * math.sqrt(tank.height) / capacity if capacity else math.inf


def time_scale(plant: PlantDescription) -> float:
    """Time scale of the plant, s: that of its emptying time, 1 s for three_tank, whose tanks empty in about 100 s.

    The emptying time A H / (C sqrt(H)) is the volume of a full tank over its outflow, the geometric mean of all tanks.
    """
    times = (tank.area * tank.height / flow_scale(plant, tank.name) for tank in plant.tanks)
    return geometric_mean(time / _EMPTYING_TIME for time in times)


def length_scale(plant: PlantDescription) -> float:
    """Length scale of the plant, m: that of its tanks' height (geometric mean), 1 m for three_tank."""
    return geometric_mean(tank.height / _HEIGHT for tank in plant.tanks)


def fastest_exchange(plant: PlantDescription) -> float:
    """The shortest time in which the water of a full tank is exchanged, relative to three_tank.

    Water enters a tank by some pipes and leaves by others, so that half of their flows at the head of a full tank
    passes through it; or what its pumps deliver, if that is more.
    """
    times = []
    for tank in plant.tanks:
        pipes = sum(nominal_capacity(plant, p) for p in plant.pipes if tank.name in (p.source, p.target))
        pumps = sum(p.max_flow for p in plant.pumps if p.target == tank.name)
        through = max(0.5 * pipes * math.sqrt(tank.height), pumps)
        times.append(tank.area * tank.height / (through or flow_scale(plant, tank.name)))
    return min(times) / _EMPTYING_TIME
