"""The levels behind readings: what the plant is believed to do to readings is taken out of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.plant.effect import Stage
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock

CORRECTIONS = 3  # a gain that is off by a tenth is then right to a thousandth
INSTANT = 1e-6  # s: what acts from the start on does so in full


def levels_behind(
    network: TankNetwork, readings: Sequence[Tensor], levels: Sequence[Tensor], start: Tensor, values: PlaceValues
) -> list[Tensor]:
    """Levels (*batch) of each tank, m, that show as these readings (*batch) of each sensor, NaN where missing, of a rig
    that has long stood so at `start` s. levels: of tanks that no sensor tells.
    """
    found = list(levels)
    sensors = list(zip(network.description.sensors, network.sensor_tanks(), strict=True))
    for (sensor, tank), reading in zip(sensors, readings, strict=True):
        shown = (reading - values[sensor.name]["offset"]) / values[sensor.name]["gain"]
        found[tank] = torch.where(torch.isfinite(shown), shown.clamp(min=0.0), found[tank])
    if any(p.effect.stage is Stage.READING for p in network.placements):
        clock = Clock(start, torch.full_like(start, INSTANT), torch.full_like(start, INSTANT))
        for _ in range(CORRECTIONS):
            seen = [found[tank] for _, tank in sensors]
            read, _ = network.read(seen, network.remember_readings(seen, clock, values), clock, values)
            for c, (sensor, tank) in enumerate(sensors):
                nearer = seen[c] + (readings[c] - read[c]) / values[sensor.name]["gain"]
                found[tank] = torch.where(torch.isfinite(nearer), nearer.clamp(min=0.0), found[tank])
    return found
