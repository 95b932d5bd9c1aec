"""A sensor whose zero drifts."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.effect import Clock, Effect, Memory, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale


class SensorDrift(Effect):
    """The reading is y + r t, with t since the recording's start (Isermann, 2006, "Fault-Diagnosis Systems", ch. 5).

    Typical: 0.5 to 10 % of the range per hour, either sign. Nearly the same as a bias in a short recording.
    """

    name = "sensor_drift"
    stage = Stage.READING
    places = ("sensor",)
    mistaken_for = ("sensor_bias", "coefficient_drift", "sensor_curvature")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.sensor(place)
        rate = 3e-4 / time_scale(plant) * reading_span(plant, sensor)
        return (
            Parameter("rate", f"{sensor.unit}/s", 0.0, -rate, rate, meaning="rate of change of the reading's error"),
        )

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return value + p["rate"] * clock.end, memory
