"""A pump that is switched off when its tank is full."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import target_height
from fdi_torch.plant.description import PlantDescription, Pump
from fdi_torch.plant.effect import Effect, Local, Stage, Values
from fdi_torch.plant.reach import Reach, inside

EDGE_SHARE = 0.02


class PumpCutOut(Effect):
    """The flow is cut where the level exceeds a limit (a float switch, a safety interlock), drawn over a fiftieth of
    the tank's height; nominal is far above the rim, where it changes nothing.

    Typical: 1 to 10 cm below the rim. Below it nothing shows.
    """

    name = "pump_cut_out"
    stage = Stage.FLOW
    places = ("pump",)
    smooth = False
    mistaken_for = ("overflow", "pump_saturation", "sensor_saturation", "pump_back_pressure")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        height = target_height(plant, place)
        return (
            Parameter("level", "m", 2.0 * height, 0.05 * height, 2.0 * height, meaning="level at which it is cut off"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        pump = plant.component(place)
        assert isinstance(pump, Pump)
        low, high = reach.levels[pump.target]
        least = 0.05 * target_height(plant, place)
        return [{"level": max(level, least)} for level in inside((0.5 * (low + high), high), 4)]

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        return flow * torch.clamp((p["level"] - local.level) / (EDGE_SHARE * local.height), 0.0, 1.0)
