"""A pipe whose flow is not proportional to the square root of the head."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values

REFERENCE_SHARE = 0.2


class FlowExponent(Effect):
    """The flow is q (|x| / x_r)^n, so that the head x has the exponent 1/2 + n (pipe friction: 4/7, Blasius, 1913;
    laminar flow: 1). The reference x_r, a fifth of the tank's height, decorrelates n from the discharge coefficient.

    Typical: n of -0.1 to 0.3. Nearly the same as laminar flow or an outlet at another height.
    """

    name = "flow_exponent"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("laminar_flow", "outlet_drop", "evaporation", "pump_offset", "sensor_bias")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("excess", "1", 0.0, -0.4, 0.6, meaning="exponent of the head less 1/2"),)

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        # exp(n log x): a power with a tensor exponent differs in its last bit alone and in a batch.
        return flow * torch.exp(p["excess"] * torch.log(local.magnitude(local.head) / (REFERENCE_SHARE * local.height)))
