"""A pipe whose flow is laminar at low heads."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import height_before
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values
from fdi_torch.plant.reach import Reach, heads

LEAST_RATIO = 1e-6  # of transition head and head, below which the flow is Torricelli's however sharp the transition
SHARPEST = 0.002


class LaminarFlow(Effect):
    """The flow is q (1 + (x_0/|x|)^(1/2s))^(-s): linear in the head x far below x_0, Torricelli's far above (the
    transition of the discharge coefficient at low Reynolds numbers; Wu et al., 2002, "Low Reynolds number orifices").
    s says over how wide a range of heads it turns over: 1/2 for q sqrt(|x| / (|x| + x_0)), about 3/4 where viscous and
    inertial losses add up, x = a q + b q^2 (Darcy-Forchheimer), 1/3 for a tanh, next to 0 for an orifice that turns
    over at one Reynolds number.

    Typical: x_0 of 5 mm to 5 cm; a long thin pipe may be laminar at most heads that it sees. Nearly the same as a
    higher exponent of the head or an outlet that lies higher.
    """

    name = "laminar_flow"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("flow_exponent", "outlet_drop", "sensor_bias", "cross_flow", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        high = height_before(plant, place)
        return (
            Parameter("transition_head", "m", 0.0, 0.0, high, meaning="head at which it turns over"),
            Parameter("softness", "1", 0.5, SHARPEST, 1.0, meaning="of the transition; 0 would be a kink"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        low = 0.03 * height_before(plant, place)
        lowest, highest = heads(plant, place, reach)
        # A kink shows only if it lies among the heads that there were.
        kink = {"transition_head": lowest + (highest - lowest) / 3, "softness": 0.03}
        return [*({"transition_head": low, "softness": s} for s in (0.67, 0.33, 0.125)), kink]

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        return flow * kept(p["transition_head"] / local.magnitude(local.head), p["softness"])


def kept(ratio: Tensor, softness: Tensor | float) -> Tensor:
    """The share of Torricelli's flow, of a ratio of transition head and head: (1 + ratio^(1/2s))^(-s)."""
    power = 0.5 / softness
    below, above = torch.clamp(ratio, LEAST_RATIO, 1.0), torch.clamp(ratio, min=1.0)
    # No part overflows. Not a power of the ratio itself: at a transition head of 0 its slope would be lost.
    inner = torch.clamp(ratio, max=1.0) * torch.exp((power - 1.0) * torch.log(below))
    outer = power * torch.log(above)
    return torch.exp(-softness * (outer + torch.log(1.0 + inner * torch.exp(-outer))))
