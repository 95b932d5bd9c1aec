"""A sensor with dead time."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale


class SensorDelay(Effect):
    """y(t) is the reading of the level at t - d, linear between samples: filters, slow buses, time stamps made on
    arrival.

    Typical: d of 1 to 20 s. Nearly the same as a lag of d, because levels move slowly.
    """

    name = "sensor_delay"
    stage = Stage.READING
    places = ("sensor",)
    delays = True
    mistaken_for = ("sensor_lag", "pump_delay", "sensor_hysteresis")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("delay", "s", 0.0, 0.0, 60.0 * time_scale(plant), meaning="dead time of the reading"),)

    def delay(self, p: Values) -> torch.Tensor:
        return p["delay"]
