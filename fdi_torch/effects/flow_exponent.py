"""A pipe whose flow is not proportional to the square root of the head."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import source_height
from fdi_torch.plant.effect import Effect, Local, Parameter, PlantDescription, Stage, Values

TYPICAL, LEAST, MOST = 0.2, 0.02, 2.0  # reference head, as a share of the tank's height


class FlowExponent(Effect):
    """The flow is q (|x| / x_r)^n, so that the head x has the exponent 1/2 + n (pipe friction: 4/7, Blasius, 1913;
    laminar flow: 1). At the reference head x_r the flow is that of the nominal law, as at the head at which the
    discharge coefficient was measured.

    Typical: n of -0.1 to 0.3. Nearly the same as laminar flow or an outlet at another height.
    """

    name = "flow_exponent"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("laminar_flow", "outlet_drop", "evaporation", "pump_offset", "sensor_bias")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        height = source_height(plant, place)
        typical, low, high = (share * height for share in (TYPICAL, LEAST, MOST))
        return (
            Parameter("excess", "1", 0.0, -0.4, 0.6, meaning="exponent of the head minus 1/2"),
            Parameter("reference", "m", typical, low, high, meaning="head at which the flow is the nominal one"),
        )

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        # exp(n log x): a power with a tensor exponent differs in its last bit alone and in a batch.
        return flow * torch.exp(p["excess"] * torch.log(local.magnitude(local.head) / p["reference"]))
