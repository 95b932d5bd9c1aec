"""A pump that delivers less as its tank fills."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, Parameter, PlantDescription, Stage, Values

DRY = 1e-6  # share of the height below which a tank counts as empty


class PumpBackPressure(Effect):
    """The flow is q (1 - c (h / H)^n): the characteristic of a centrifugal pump about its working point, linear or
    drooping (Gülich, 2014, "Centrifugal Pumps", ch. 4), for a pump that feeds its tank from below.

    Typical: c of 0.05 to 0.5 at the rim, n of 1 to 2. The same as a lower gain while the level hardly moves.
    """

    name = "pump_back_pressure"
    stage = Stage.FLOW
    places = ("pump",)
    mistaken_for = ("pump_gain", "actuator_stuck", "pump_saturation", "flow_exponent", "leak")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("loss", "1", 0.0, -0.5, 1.0, meaning="share of the flow lost when the tank is full"),
            Parameter("droop", "1", 1.0, 1.0, 3.0, meaning="exponent of the level"),
        )

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        share = torch.clamp(local.level / local.height, min=DRY)
        return flow * torch.clamp(1.0 - p["loss"] * torch.exp(p["droop"] * torch.log(share)), min=0.0)
