"""A discharge coefficient that changes slowly."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values


class CoefficientDrift(Effect):
    """The flow is q (1 + r t), t on the recording's own clock: growth of deposits, warming water.

    Typical: r of 2 to 30 % an hour, either sign. Over a short recording the same as plugging.
    """

    name = "coefficient_drift"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("unmetered_flow", "plugging", "sensor_drift", "flow_exponent")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("rate", "1/s", 0.0, -3e-4, 3e-4, meaning="share of the flow gained each second"),)

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        return flow * torch.clamp(1.0 + p["rate"] * local.clock.middle, min=0.0)
