"""A valve that is not the only resistance of its pipe."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.reach import Reach
from fdi_torch.plant.signals import Clock


class ValveAuthority(Effect):
    """The opening o acts as o / sqrt(1 - s + s o^2): of the head across the pipe a share s is lost outside the valve
    when that is fully open (installed characteristic, authority 1 - s; IEC 60534-2-1). The flow rises steeply at first
    and hardly any more near the end; closed and fully open nothing changes.

    Typical: s of 0.3 to 0.95, pipes no wider than their valve. At one opening it is the same as plugging.
    """

    name = "valve_authority"
    stage = Stage.COMMAND
    places = ("valve",)
    mistaken_for = ("valve_characteristic", "valve_dead_zone", "valve_leak", "actuator_stuck", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("series", "1", 0.0, 0.0, 0.99, meaning="share of the head lost outside the open valve"),)

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        return [{"series": share} for share in (0.5, 0.9)]

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        opening = torch.clamp(value, 0.0, 1.0)
        return opening / torch.sqrt(1.0 - p["series"] + p["series"] * opening * opening), memory
