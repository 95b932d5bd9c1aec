"""A pump that is switched off when its tank is full."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import interior_points

EDGE_SHARE = 0.02


class PumpCutOut(Effect):
    """The flow is cut off above a level (a float switch, an interlock), smoothed over 2 % of the tank's height. The
    nominal level is far above the rim, where the effect is absent.

    Typical: 1 to 10 cm below the rim. No effect below that level.
    """

    name = "pump_cut_out"
    stage = Stage.FLOW
    places = ("pump",)
    smooth = False
    searched = False
    mistaken_for = ("overflow", "pump_saturation", "sensor_saturation", "pump_back_pressure")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        height = plant.tank(plant.flow(place).target).height
        return (Parameter("level", "m", 2.0 * height, 0.05 * height, 2.0 * height, meaning="cut-off level"),)

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        tank = plant.tank(plant.flow(place).target)
        low, high = operating_range.levels[tank.name]
        least = 0.05 * tank.height
        return [{"level": max(level, least)} for level in interior_points((0.5 * (low + high), high), 4)]

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * torch.clamp((p["level"] - local.level) / (EDGE_SHARE * local.height), 0.0, 1.0)
