"""A valve that stays closed at small openings."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, OperatingRange, Parameter, PlantDescription, Stage, Values


class ValveDeadZone(Effect):
    """The opening o acts as max(o - d, 0) / (1 - d): ball and gate valves pass nothing in the first part of their
    stroke.

    Typical: d of 0.05 to 0.4. The same as plugging if the opening is constant.
    """

    name = "valve_dead_zone"
    stage = Stage.COMMAND
    places = ("valve",)
    mistaken_for = ("valve_leak", "actuator_stuck", "valve_characteristic", "valve_authority", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("dead_zone", "1", 0.0, 0.0, 0.9, meaning="opening below which the valve is closed"),)

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        return [{"dead_zone": opening} for opening in (0.05, 0.15, 0.3, 0.5)]

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return torch.clamp(value - p["dead_zone"], min=0.0) / (1.0 - p["dead_zone"]), memory
