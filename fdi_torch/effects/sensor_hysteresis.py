"""A sensor that sticks within a band when the level turns."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.signals import Clock


class SensorHysteresis(Effect):
    """Backlash (play operator; Visintin, 1994, "Differential Models of Hysteresis"): the reading stays until the
    level has moved by b away from it, and then follows b behind.

    Typical: b of 0.1 to 2 % of the range. Near turning points it is the same as a lag.
    """

    name = "sensor_hysteresis"
    stage = Stage.READING
    places = ("sensor",)
    memory = 1
    mistaken_for = ("sensor_lag", "sensor_delay", "sensor_quantization")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        high = 0.1 * reading_span(plant, sensor)
        return (Parameter("play", sensor.unit, 0.0, 0.0, high, meaning="half the width of the band"),)

    def remember(self, value: Tensor, p: Values) -> Memory:
        return (value,)

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        behind = memory[0] - value
        # Not a clamp between -play and play: at a play of 0 its ends meet and their slopes cancel.
        kept = torch.sign(behind) * torch.minimum(torch.abs(behind), p["play"])
        return value + kept, (value + kept,)
