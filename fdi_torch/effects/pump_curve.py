"""A pump or transfer whose delivery is a nonlinear function of its command."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, Parameter, PlantDescription, Stage, Values


class PumpCurve(Effect):
    """The flow is q (1 + c (1 - q / q_max)): unchanged at zero and at the limit, with the largest deviation c q_max / 4
    between.

    Typical: c of -0.4 to 0.4. The same as a gain and an offset if the command takes only two values.
    """

    name = "pump_curve"
    stage = Stage.FLOW
    places = ("pump",)
    searched = False
    mistaken_for = ("pump_offset", "pump_dead_zone", "pump_gain", "pump_saturation")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("bend", "1", 0.0, -0.95, 0.95, meaning="relative extra flow at small commands"),)

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * (1.0 + p["bend"] * (1.0 - flow / local.constants["max_flow"]))
