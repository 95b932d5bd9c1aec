"""A sensor whose characteristic is bent."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.signals import Clock


class SensorCurvature(Effect):
    """y + c y^2: a pressure cell or ultrasonic sensor linearised once and never again.

    Typical: c times the range of 0.01 to 0.1. Over a narrow range of levels the same as another gain.
    """

    name = "sensor_curvature"
    stage = Stage.READING
    places = ("sensor",)
    mistaken_for = ("sensor_gain", "sensor_stuck", "sensor_bias", "sensor_saturation")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        far = 0.5 / reading_span(plant, sensor)
        unit = "1" if sensor.unit == "1" else f"1/{sensor.unit}"
        return (Parameter("bend", unit, 0.0, -far, far, meaning="share it reads too much, at a reading of 1"),)

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return value + p["bend"] * value * value, memory
