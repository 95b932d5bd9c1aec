"""A pump that acts late."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Stage, Values
from fdi_torch.plant.pace import time_scale


class PumpDelay(Effect):
    """v(t) = u(t - d): transport along a hose, a slow bus, a controller that waits. The delayed command is averaged
    over each step exactly, so that d need not be a multiple of anything.

    Typical: d of 1 to 20 s. Nearly the same as a lag of d.
    """

    name = "pump_delay"
    stage = Stage.COMMAND
    places = ("pump",)
    delays = True
    mistaken_for = ("pump_lag", "actuator_slew", "sensor_delay", "sensor_lag")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("delay", "s", 0.0, 0.0, 60.0 * time_scale(plant), meaning="how late the pump acts"),)

    def delay(self, p: Values) -> Tensor:
        return p["delay"]
