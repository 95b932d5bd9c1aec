"""A valve in series with other flow resistances of its pipe."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, OperatingRange, Parameter, PlantDescription, Stage, Values


class ValveAuthority(Effect):
    """The opening o acts as o / sqrt(1 - s + s o^2): when fully open, a share s of the pipe's head is lost outside the
    valve (installed characteristic, authority 1 - s; IEC 60534-2-1). The flow rises steeply at first and hardly near
    the end; closed and fully open positions are unchanged.

    Typical: s of 0.3 to 0.95, for pipes no wider than their valve. The same as plugging if the opening is constant.
    """

    name = "valve_authority"
    stage = Stage.COMMAND
    places = ("valve",)
    mistaken_for = ("valve_characteristic", "valve_dead_zone", "valve_leak", "actuator_stuck", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("series", "1", 0.0, 0.0, 0.99, meaning="share of the head lost outside the open valve"),)

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        return [{"series": share} for share in (0.5, 0.9)]

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        opening = torch.clamp(value, 0.0, 1.0)
        return opening / torch.sqrt(1.0 - p["series"] + p["series"] * opening * opening), memory
