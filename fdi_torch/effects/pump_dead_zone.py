"""A pump or transfer that does not start at small commands."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, OperatingRange, Parameter, PlantDescription, Stage, Values


class PumpDeadZone(Effect):
    """The command acts as max(u - d, 0) (friction and back pressure; DC pumps start at 10 to 40 % of full duty).

    Typical: d of 2 to 40 % of the full command. The same as a constant draw without end, or as a negative offset of the
    pump, while the command stays above d.
    """

    name = "pump_dead_zone"
    stage = Stage.COMMAND
    places = ("pump",)
    mistaken_for = ("pump_offset", "evaporation", "unmetered_flow", "pump_gain", "pump_curve", "flow_exponent")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        pump = plant.metered_flow(place)
        full = pump.full_command
        return (Parameter("dead_zone", pump.command_unit, 0.0, 0.0, full, meaning="command at which the pump starts"),)

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        full = plant.metered_flow(place).full_command
        return [{"dead_zone": share * full} for share in (0.03, 0.1, 0.25, 0.5, 0.9)]

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        # At command 0 and dead zone 0 the clamp alone would have a slope, although a pump at rest cannot deliver less.
        return torch.where(value > 0.0, torch.clamp(value - p["dead_zone"], min=0.0), torch.zeros_like(value)), memory
