"""A pipe whose flow is laminar at low heads."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import source_height
from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import head_range

LEAST_RATIO = 1e-6  # transition head / head, below which the flow follows Torricelli's law for any softness
SHARPEST = 0.002


class LaminarFlow(Effect):
    """The flow is q (1 + (x_0/|x|)^(1/2s))^(-s): linear in the head x far below x_0, Torricelli's law far above it
    (discharge coefficient at low Reynolds numbers; Wu et al., 2002, "Low Reynolds number orifices"). The softness s is
    the width of the transition: 1/2 for q sqrt(|x| / (|x| + x_0)), about 3/4 if viscous and inertial losses add up, x =
    a q + b q^2 (Darcy-Forchheimer), 1/3 close to a tanh, near 0 for an orifice with a transition at one Reynolds
    number.

    Typical: x_0 of 5 mm to 5 cm; a long thin pipe may be laminar at most of its heads. Nearly the same as a larger
    exponent of the head or a higher outlet.
    """

    name = "laminar_flow"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("flow_exponent", "outlet_drop", "sensor_bias", "cross_flow", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        high = source_height(plant, place)
        return (
            Parameter("transition_head", "m", 0.0, 0.0, high, meaning="head at the transition"),
            Parameter("softness", "1", 0.5, SHARPEST, 1.0, meaning="width of the transition; 0 would be a kink"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        low = 0.03 * source_height(plant, place)
        lowest, highest = head_range(plant, place, operating_range)
        # A kink is visible only within the range of heads of the recording.
        kink = {"transition_head": lowest + (highest - lowest) / 3, "softness": 0.03}
        return [*({"transition_head": low, "softness": s} for s in (0.67, 0.33, 0.125)), kink]

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * torricelli_share(p["transition_head"] / local.magnitude(local.head), p["softness"])


def torricelli_share(ratio: torch.Tensor, softness: torch.Tensor | float) -> torch.Tensor:
    """The flow relative to Torricelli's law, (1 + ratio^(1/2s))^(-s), for ratio = transition head / head and softness
    s.
    """
    power = 0.5 / softness
    below, above = torch.clamp(ratio, LEAST_RATIO, 1.0), torch.clamp(ratio, min=1.0)
    # Split at ratio 1 so that no term overflows; the factor `ratio` keeps the slope at a transition head of 0.
    inner = torch.clamp(ratio, max=1.0) * torch.exp((power - 1.0) * torch.log(below))
    outer = power * torch.log(above)
    return torch.exp(-softness * (outer + torch.log(1.0 + inner * torch.exp(-outer))))
