"""A pump that stands still at small commands."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription, Pump
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.reach import Reach
from fdi_torch.plant.signals import Clock


class PumpDeadZone(Effect):
    """The command acts as max(u - d, 0) (friction and back pressure; DC pumps start at a tenth to four tenths of full
    duty).

    Typical: d of 2 to 40 % of the full command. While the command stays above d it is the same as a constant draw
    that never ends, or a negative offset of the pump.
    """

    name = "pump_dead_zone"
    stage = Stage.COMMAND
    places = ("pump",)
    mistaken_for = ("pump_offset", "evaporation", "unmetered_flow", "pump_gain", "pump_curve", "flow_exponent")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        pump = plant.component(place)
        assert isinstance(pump, Pump)
        full = pump.max_flow / pump.gain
        return (Parameter("dead_zone", pump.command_unit, 0.0, 0.0, full, meaning="command at which the pump starts"),)

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        pump = plant.component(place)
        assert isinstance(pump, Pump)
        full = pump.max_flow / pump.gain
        return [{"dead_zone": share * full} for share in (0.03, 0.1, 0.25, 0.5, 0.9)]

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        # At rest and at a dead zone of 0 the clamp alone would have a slope: less than nothing is pumped.
        return torch.where(value > 0.0, torch.clamp(value - p["dead_zone"], min=0.0), torch.zeros_like(value)), memory
