"""A pump or transfer with dead time."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale


class PumpDelay(Effect):
    """v(t) = u(t - d): transport along a hose, a slow bus, a controller that waits. The delayed command is averaged
    exactly over each step, so that d need not be a multiple of the step.

    Typical: d of 1 to 20 s. Nearly the same as a lag of d.
    """

    name = "pump_delay"
    stage = Stage.COMMAND
    places = ("pump",)
    delays = True
    mistaken_for = ("pump_lag", "actuator_slew", "sensor_delay", "sensor_lag")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("delay", "s", 0.0, 0.0, 60.0 * time_scale(plant), meaning="dead time of the pump"),)

    def delay(self, p: Values) -> torch.Tensor:
        return p["delay"]
