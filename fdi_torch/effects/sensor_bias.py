"""A sensor that reads too high or too low by a constant."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.effect import Clock, Effect, Memory, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import timed_starts


class SensorBias(Effect):
    """The reading is y + b from an onset on, at once or over a ramp (abrupt and incipient bias; Isermann, 2006,
    "Fault-Diagnosis Systems", ch. 5).

    Typical: 0.2 to 5 % of the range. From the start of a recording it is indistinguishable from an error of the
    sensor's `offset`; in a plant at rest with one sensor, also from a leak or plugging.
    """

    name = "sensor_bias"
    stage = Stage.READING
    places = ("sensor",)
    instants = ("onset",)
    mistaken_for = ("sensor_gain", "laminar_flow", "flow_exponent", "outlet_drop", "sensor_drift")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.sensor(place)
        largest = 0.5 * reading_span(plant, sensor)
        return (
            Parameter("bias", sensor.unit, 0.0, -largest, largest, meaning="constant error of the reading"),
            Parameter("onset", "s", 0.0, 0.0, meaning="time at which it begins"),
            Parameter("ramp", "s", 0.0, 0.0, meaning="time until full size"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        sensor = plant.sensor(place)
        bias = 0.02 * reading_span(plant, sensor)
        return timed_starts([{"bias": bias}, {"bias": -bias}], operating_range)

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return value + p["bias"] * clock.risen_by_end(p["onset"], p["ramp"]), memory
