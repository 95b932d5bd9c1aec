"""A hole in a tank's wall."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription, Tank
from fdi_torch.plant.effect import Effect, Local, Stage, Values
from fdi_torch.plant.reach import Reach, inside, onsets


class Leak(Effect):
    """Outflow s(t) C sqrt(2 g) sqrt(h - z) through a hole at height z, from an onset on, at once or over a ramp (2020
    paper, eq. 27, 30).

    size: the hole's capacity as a share of the tank's leak reference (theta_1, theta_3 of eq. 31). Typical: 0.05 to
    0.5. At the floor of a tank with an outlet it is the same as a wider outlet.
    """

    name = "leak"
    stage = Stage.BALANCE
    places = ("tank",)
    mistaken_for = ("plugging", "net_outlet", "valve_leak", "unmetered_flow", "cross_flow", "overflow", "evaporation")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        tank = plant.component(place)
        assert isinstance(tank, Tank)
        return (
            Parameter("size", "1", 0.0, 0.0, 1.0, meaning="capacity of the hole as a share of the reference pipe's"),
            Parameter("height", "m", 0.0, 0.0, 0.95 * tank.height, meaning="height of the hole above the floor"),
            Parameter("onset", "s", 0.0, 0.0, meaning="when it opens"),
            Parameter("ramp", "s", 0.0, 0.0, meaning="how long it takes to open in full"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        low, high = reach.levels[place]
        at_height = [{"size": 0.1, "height": height} for height in (0.5 * low, *inside((low, high), 3))]
        growing = {"size": 0.1, "onset": 0.3 * reach.duration, "ramp": 0.7 * reach.duration}
        opened = [{"size": 0.1, "onset": instant} for instant in onsets(reach)]
        return [{"size": 0.1}, *at_height, *opened, growing]

    def inflow(self, local: Local, p: Values) -> Tensor:
        head = torch.clamp(local.level - p["height"], min=0.0)
        return -p["size"] * local.clock.risen(p["onset"], p["ramp"]) * local.capacity * local.root(head)
