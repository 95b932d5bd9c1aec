"""A hole in a tank's wall."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription, Tank
from fdi_torch.plant.effect import Effect, Local, Stage, Values


class Leak(Effect):
    """Outflow s(t) C sqrt(2 g) sqrt(h - z) through a hole at height z, from an onset on (2020 paper, eq. 27, 30).

    size: the hole's capacity as a share of the tank's leak reference (theta_1, theta_3 of eq. 31).
    Typical: 0.05 to 0.5. At the floor of a tank with an outlet it is the same as a wider outlet.
    """

    name = "leak"
    stage = Stage.BALANCE
    places = ("tank",)
    mistaken_for = ("plugging at the outlet", "unmetered_flow", "cross_flow", "overflow")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        tank = plant.component(place)
        assert isinstance(tank, Tank)
        return (
            Parameter("size", "1", 0.0, 0.0, 1.0, meaning="capacity of the hole as a share of the reference pipe's"),
            Parameter("height", "m", 0.0, 0.0, 0.95 * tank.height, meaning="height of the hole above the floor"),
            Parameter("onset", "s", 0.0, 0.0, meaning="when it opens"),
        )

    def inflow(self, local: Local, p: Values) -> Tensor:
        head = torch.clamp(local.level - p["height"], min=0.0)
        return -p["size"] * local.clock.share_after(p["onset"]) * local.capacity * local.root(head)
