"""A sensor that cannot read below some level."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.effects.clipping import clipping_bias, noise_parameters
from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import reading_at
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.operating_range import OperatingRange, interior_points
from fdi_torch.plant.signals import Clock


class SensorFloor(Effect):
    """max(y, y_min), before noise: a sensor above the floor that falls dry. The nominal limit is far below the range,
    where the effect is absent. If the noise is clipped with the level, the reading is the mean of max(y + e, y_min), as
    in `sensor_saturation`.

    Typical: 1 to 10 % of the range. No effect above the limit.
    """

    name = "sensor_floor"
    stage = Stage.READING
    places = ("sensor",)
    smooth = False
    mistaken_for = ("sensor_bias", "outlet_drop", "sensor_curvature")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        bottom = min(reading_at(plant, sensor, share) for share in (-1.0, 2.0))
        high = max(reading_at(plant, sensor, share) for share in (0.0, 1.0))
        limit = Parameter("limit", sensor.unit, bottom, bottom, high, meaning="least reading")
        return (limit, *noise_parameters(sensor.unit))

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        low, high = operating_range.readings[place]
        return [{"limit": limit} for limit in interior_points((low, 0.5 * (low + high)), 5)]

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return torch.maximum(value, p["limit"]) + clipping_bias(p["limit"] - value, p), memory
