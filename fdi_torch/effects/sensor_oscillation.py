"""A sensor with a sine superimposed on its reading."""

from __future__ import annotations

import math

import torch

from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.effect import Clock, Effect, Memory, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale


class SensorOscillation(Effect):
    """The reading is y + a sin(2 pi t / T + phi): surface waves, mains hum, aliasing with the sampling (Isermann, 2006,
    "Fault-Diagnosis Systems", ch. 5).

    Typical: a of 0.2 to 2 % of the range. Periods below two samples appear as slower oscillations (aliasing).
    """

    name = "sensor_oscillation"
    stage = Stage.READING
    places = ("sensor",)
    searched = False
    mistaken_for = ("pump_oscillation", "sensor_bias")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.sensor(place)
        high = 0.3 * reading_span(plant, sensor)
        scale = time_scale(plant)
        return (
            Parameter("amplitude", sensor.unit, 0.0, 0.0, high, meaning="amplitude"),
            Parameter("period", "s", 60.0 * scale, 2.0 * scale, 3600.0 * scale, meaning="period of the oscillation"),
            Parameter("phase", "1", 0.0, -math.pi, math.pi, meaning="phase at t = 0, rad"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        sensor = plant.sensor(place)
        amplitude = 0.01 * reading_span(plant, sensor)
        periods = [time_scale(plant) * seconds for seconds in (5.0, 10.0, 30.0, 60.0, 120.0, 300.0)]
        return [{"amplitude": amplitude, "period": t, "phase": phase} for t in periods for phase in (-1.5, 1.5)]

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return value + p["amplitude"] * torch.sin(2.0 * math.pi * clock.end / p["period"] + p["phase"]), memory
