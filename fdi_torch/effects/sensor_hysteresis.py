"""A sensor with backlash when the level turns."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.effect import Clock, Effect, Memory, Parameter, PlantDescription, Stage, Values


class SensorHysteresis(Effect):
    """Play operator (Visintin, 1994, "Differential Models of Hysteresis"): the reading holds until the level is b away
    from it, and then follows at the distance b.

    Typical: b of 0.1 to 2 % of the range. Nearly the same as a lag near turning points.
    """

    name = "sensor_hysteresis"
    stage = Stage.READING
    places = ("sensor",)
    memory = 1
    searched = False
    mistaken_for = ("sensor_lag", "sensor_delay", "sensor_quantization")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.sensor(place)
        high = 0.1 * reading_span(plant, sensor)
        return (Parameter("play", sensor.unit, 0.0, 0.0, high, meaning="half the width of the band"),)

    def steady_memory(self, value: torch.Tensor, p: Values) -> Memory:
        return (value,)

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        distance = memory[0] - value
        # A clamp to -play..play would lose its slope at a play of 0, where both limits coincide.
        lag = torch.sign(distance) * torch.minimum(torch.abs(distance), p["play"])
        return value + lag, (value + lag,)
