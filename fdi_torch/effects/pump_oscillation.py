"""A pump whose delivery swings."""

from __future__ import annotations

import math

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values
from fdi_torch.plant.pace import time_scale
from fdi_torch.plant.reach import Reach


class PumpOscillation(Effect):
    """q (1 + a sin(2 pi t / T + phi)): a hunting controller, a worn diaphragm. The swing is averaged over each step.

    Typical: a of 0.05 to 0.3, T of 10 to 300 s; tanks smooth away anything faster.
    """

    name = "pump_oscillation"
    stage = Stage.FLOW
    places = ("pump",)
    on_clock = ("phase",)
    mistaken_for = ("sensor_oscillation", "pump_gain")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        pace = time_scale(plant)
        return (
            Parameter("amplitude", "1", 0.0, 0.0, 1.0, meaning="swing as a share of the flow"),
            Parameter("period", "s", 60.0 * pace, 2.0 * pace, 3600.0 * pace, meaning="of the swing"),
            Parameter("phase", "1", 0.0, -math.pi, math.pi, meaning="of the swing at t = 0, in radians"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        periods = [time_scale(plant) * seconds for seconds in (10.0, 30.0, 60.0, 120.0, 300.0)]
        return [{"amplitude": 0.1, "period": period, "phase": phase} for period in periods for phase in (-1.5, 1.5)]

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        return flow * (1.0 + p["amplitude"] * local.clock.sine(p["period"], p["phase"]))
