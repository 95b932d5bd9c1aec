"""A pipe whose flow is laminar at low heads."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import height_before
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values


class LaminarFlow(Effect):
    """The flow is q sqrt(|x| / (|x| + x_0)): linear in the head x far below x_0, Torricelli's far above (the
    transition of the discharge coefficient at low Reynolds numbers; Wu et al., 2002, "Low Reynolds number orifices").

    Typical: x_0 of 5 mm to 5 cm. Nearly the same as a higher exponent of the head or an outlet that lies higher.
    """

    name = "laminar_flow"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("flow_exponent", "outlet_drop", "sensor_bias", "cross_flow", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        high = 0.3 * height_before(plant, place)
        return (Parameter("transition_head", "m", 0.0, 0.0, high, meaning="head at which it turns over"),)

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        return flow / torch.sqrt(1.0 + p["transition_head"] / local.magnitude(local.head))
