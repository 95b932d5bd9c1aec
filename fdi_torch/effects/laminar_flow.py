"""A pipe whose flow is laminar at low heads."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import height_before
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values
from fdi_torch.plant.reach import Reach

LEAST_RATIO = 1e-6  # of transition head and head, below which the flow is Torricelli's however sharp the transition


class LaminarFlow(Effect):
    """The flow is q (1 + (x_0/|x|)^(n/2))^(-1/n): linear in the head x far below x_0, Torricelli's far above (the
    transition of the discharge coefficient at low Reynolds numbers; Wu et al., 2002, "Low Reynolds number orifices").
    n says how sharp the transition is: 2 for q sqrt(|x| / (|x| + x_0)), about 1.3 where viscous and inertial losses add
    up, x = a q + b q^2 (Darcy-Forchheimer), 3 for a tanh, many for an orifice that turns over at one Reynolds number.

    Typical: x_0 of 5 mm to 5 cm. Nearly the same as a higher exponent of the head or an outlet that lies higher.
    """

    name = "laminar_flow"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("flow_exponent", "outlet_drop", "sensor_bias", "cross_flow", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        high = 0.3 * height_before(plant, place)
        return (
            Parameter("transition_head", "m", 0.0, 0.0, high, meaning="head at which it turns over"),
            Parameter("sharpness", "1", 2.0, 1.0, 20.0, meaning="of the transition"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        head = 0.03 * height_before(plant, place)
        return [{"transition_head": head, "sharpness": n} for n in (1.5, 3.0, 8.0)]

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        ratio = p["transition_head"] / local.magnitude(local.head)
        # Not a power of the ratio itself: at a transition head of 0 its slope would be lost.
        sharper = torch.exp((0.5 * p["sharpness"] - 1.0) * torch.log(torch.clamp(ratio, min=LEAST_RATIO)))
        return flow * torch.exp(-torch.log(1.0 + ratio * sharper) / p["sharpness"])
