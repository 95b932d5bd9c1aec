"""Inverted sensors: the tank levels that a plant's sensors would show as given readings."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.plant.effect import Stage
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock

CORRECTIONS = 3  # each one cuts the error by the relative error of the gain: 10 % becomes 0.1 %
INSTANT = 1e-6  # s; a step so short that time-dependent effects act with their value at the start


def levels_from_readings(
    network: TankNetwork, readings: Sequence[Tensor], levels: Sequence[Tensor], start: Tensor, values: PlaceValues
) -> list[Tensor]:
    """Level of each tank (*batch), m, whose steady reading equals the given one.

    The sensor's gain and offset are inverted exactly. READING effects are inverted by `CORRECTIONS` simplified Newton
    steps, h <- h + (y - y(h)) / gain, with their memories in steady state at `start` (s).

    readings: one tensor (*batch) per sensor, in its unit; NaN where missing. levels: fallback (*batch) for each tank
    without a sensor or with a missing reading, m.
    """
    estimates = list(levels)
    sensors = list(zip(network.description.sensors, network.sensor_tanks(), strict=True))
    for (sensor, tank), reading in zip(sensors, readings, strict=True):
        level = (reading - values[sensor.name]["offset"]) / values[sensor.name]["gain"]
        estimates[tank] = torch.where(torch.isfinite(level), level.clamp(min=0.0), estimates[tank])
    if any(p.effect.stage is Stage.READING for p in network.placements):
        clock = Clock(start, torch.full_like(start, INSTANT), torch.full_like(start, INSTANT))
        for _ in range(CORRECTIONS):
            measured = [estimates[tank] for _, tank in sensors]
            predicted, _ = network.read(measured, network.steady_reading_memory(measured, clock, values), clock, values)
            for c, (sensor, tank) in enumerate(sensors):
                corrected = measured[c] + (readings[c] - predicted[c]) / values[sensor.name]["gain"]
                estimates[tank] = torch.where(torch.isfinite(corrected), corrected.clamp(min=0.0), estimates[tank])
    return estimates
