"""A valve that does not close fully."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, Parameter, PlantDescription, Stage, Values


class ValveLeak(Effect):
    """The opening o acts as o + s (1 - o): worn seats, dirt, a position sensor that reads closed too early.

    Typical: s of 0.005 to 0.1. The same as a wider pipe if the opening is constant.
    """

    name = "valve_leak"
    stage = Stage.COMMAND
    places = ("valve",)
    mistaken_for = ("valve_dead_zone", "actuator_stuck", "valve_characteristic", "leak", "cross_flow", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "1", 0.0, 0.0, 1.0, meaning="flow when closed relative to fully open", extremes=(1.0,)),
        )

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return value + p["size"] * (1.0 - value), memory
