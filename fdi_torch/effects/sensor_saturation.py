"""A sensor that cannot read above some level."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.effects.clipping import lost_to_noise, noise_parameters
from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import reading_at
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.reach import Reach, inside
from fdi_torch.plant.signals import Clock


class SensorSaturation(Effect):
    """min(y, y_max), before noise; nominal is far above what the tank can hold, where it changes nothing. Where the
    noise is clipped with the level, the mean of min(y + e, y_max) for a noise of that standard deviation: at the limit
    0.4 of it less; where noise comes behind a limit and meets it again, also beyond.

    Typical: 60 to 95 % of the range. Below it nothing shows. A rig that clips its noisy readings says so in the plant
    file (high).
    """

    name = "sensor_saturation"
    stage = Stage.READING
    places = ("sensor",)
    smooth = False
    mistaken_for = ("overflow", "pump_cut_out", "sensor_curvature")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        top = max(reading_at(plant, sensor, share) for share in (-1.0, 2.0))
        low = min(reading_at(plant, sensor, share) for share in (0.0, 1.0))
        limit = Parameter("limit", sensor.unit, top, low, top, meaning="the most it reads")
        return (limit, *noise_parameters(sensor.unit))

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        low, high = reach.readings[place]
        return [{"limit": limit} for limit in inside((0.5 * (low + high), high), 5)]

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return torch.minimum(value, p["limit"]) - lost_to_noise(value - p["limit"], p), memory
