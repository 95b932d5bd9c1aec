"""A sensor with a curved characteristic."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import reading_at, reading_span
from fdi_torch.plant.effect import Clock, Effect, Memory, OperatingRange, Parameter, PlantDescription, Stage, Values


class SensorCurvature(Effect):
    """The reading is y + c (y - y_m)^2: a sensor linearised at the middle y_m of its range.

    Typical: c times the sensor's range is 0.01 to 0.1 for pressure cells, up to 0.5 for capacitive and float sensors.
    Over a narrow range of levels it acts like a wrong gain.
    """

    name = "sensor_curvature"
    stage = Stage.READING
    places = ("sensor",)
    searched = False
    mistaken_for = ("sensor_gain", "sensor_stuck", "sensor_bias", "sensor_saturation")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.sensor(place)
        far = 1.0 / reading_span(plant, sensor)  # beyond it, two levels would have the same reading
        unit = "1" if sensor.unit == "1" else f"1/{sensor.unit}"
        middle = reading_at(plant, sensor, 0.5)
        return (
            Parameter(
                "bend", unit, 0.0, -far, far, meaning="relative error of the reading per distance from the middle"
            ),
            Parameter("middle", sensor.unit, middle, meaning="reading without error"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        sensor = plant.sensor(place)
        return [{"bend": share / reading_span(plant, sensor)} for share in (0.1, -0.1)]

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return value + p["bend"] * (value - p["middle"]) * (value - p["middle"]), memory
