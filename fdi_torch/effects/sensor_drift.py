"""A sensor whose zero wanders."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.pace import time_scale
from fdi_torch.plant.signals import Clock


class SensorDrift(Effect):
    """y + r t, t on the recording's own clock (Isermann, 2006, "Fault-Diagnosis Systems", ch. 5).

    Typical: 0.5 to 10 % of the range an hour, either sign. Over a short recording the same as a bias.
    """

    name = "sensor_drift"
    stage = Stage.READING
    places = ("sensor",)
    on_clock = ("rate",)
    mistaken_for = ("sensor_bias", "coefficient_drift", "sensor_curvature")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        rate = 3e-4 / time_scale(plant) * reading_span(plant, sensor)
        return (Parameter("rate", f"{sensor.unit}/s", 0.0, -rate, rate, meaning="what it reads too much, each second"),)

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return value + p["rate"] * clock.end, memory
