"""A sensor whose characteristic is bent."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import reading_at, reading_span
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.reach import Reach
from fdi_torch.plant.signals import Clock


class SensorCurvature(Effect):
    """y + c (y - y_m)^2: a sensor linearised at the middle of its range, y_m, and used over all of it.

    Typical: c times the range of 0.01 to 0.1 for pressure cells, to 0.5 for capacitive and float sensors. Over a
    narrow range of levels the same as another gain.
    """

    name = "sensor_curvature"
    stage = Stage.READING
    places = ("sensor",)
    mistaken_for = ("sensor_gain", "sensor_stuck", "sensor_bias", "sensor_saturation")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        far = 1.0 / reading_span(plant, sensor)  # beyond, two levels would read the same
        unit = "1" if sensor.unit == "1" else f"1/{sensor.unit}"
        middle = reading_at(plant, sensor, 0.5)
        return (
            Parameter("bend", unit, 0.0, -far, far, meaning="share it reads too much, so far from the middle"),
            Parameter("middle", sensor.unit, middle, meaning="reading at which it reads right"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        return [{"bend": share / reading_span(plant, sensor)} for share in (0.1, -0.1)]

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return value + p["bend"] * (value - p["middle"]) * (value - p["middle"]), memory
