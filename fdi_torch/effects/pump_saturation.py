"""A pump that delivers less at most than it is believed to."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription, Pump
from fdi_torch.plant.effect import Effect, Local, Stage, Values
from fdi_torch.plant.reach import Reach, inside


class PumpSaturation(Effect):
    """The flow is min(q, q_max); nominal is the limit of the plant file, where it changes nothing.

    Typical: 60 to 90 % of the believed limit. Nothing shows while the commands stay below it.
    """

    name = "pump_saturation"
    stage = Stage.FLOW
    places = ("pump",)
    smooth = False
    mistaken_for = ("pump_gain", "actuator_stuck", "pump_curve", "pump_back_pressure", "pump_cut_out")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        pump = plant.component(place)
        assert isinstance(pump, Pump)
        full = pump.max_flow
        return (Parameter("limit", "m^3/s", full, 0.0, full, meaning="the most that the pump delivers"),)

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        pump = plant.component(place)
        assert isinstance(pump, Pump)
        commanded = tuple(min(max(pump.gain * u, 0.0), pump.max_flow) for u in reach.commands[pump.channel])
        return [{"limit": limit} for limit in inside((commanded[0], commanded[1]), 7)]

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        return torch.minimum(flow, p["limit"])
