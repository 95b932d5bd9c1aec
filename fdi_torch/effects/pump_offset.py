"""A pump or transfer whose delivery is shifted by a constant flow."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, Parameter, PlantDescription, Stage, Values


class PumpOffset(Effect):
    """The flow is max(q + c, 0): a siphon, a bypass, a command with a wrong zero.

    Typical: 1 to 10 % of the full flow, either sign. The same as a constant inflow without end; a negative one is the
    same as a dead zone while the pump runs.
    """

    name = "pump_offset"
    stage = Stage.FLOW
    places = ("pump",)
    searched = False
    mistaken_for = ("pump_dead_zone", "evaporation", "unmetered_flow", "pump_gain", "pump_curve", "flow_exponent")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        pump = plant.metered_flow(place)
        far = 0.5 * pump.max_flow
        return (Parameter("offset", "m^3/s", 0.0, -far, far, meaning="additional flow"),)

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return torch.clamp(flow + p["offset"], min=0.0)
