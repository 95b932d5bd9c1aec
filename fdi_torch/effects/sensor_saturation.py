"""A sensor that cannot read above some level."""

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


class SensorSaturation(Effect):
    """min(y, y_max), before noise. The nominal limit is far above the range, where the effect is absent. If the noise
    is clipped with the level, the reading is the mean of min(y + e, y_max), at the limit 0.4 standard deviations below
    it; the share `behind` of the noise is added after a first limit and lowers the reading beyond the limit too.

    Typical: 60 to 95 % of the range. No effect below the limit. A rig with a known limit has it in the plant file
    (high).
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
        limit = Parameter("limit", sensor.unit, top, low, top, meaning="greatest reading")
        return (limit, *noise_parameters(sensor.unit))

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        low, high = operating_range.readings[place]
        return [{"limit": limit} for limit in interior_points((0.5 * (low + high), high), 5)]

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return torch.minimum(value, p["limit"]) - clipping_bias(value - p["limit"], p), memory
