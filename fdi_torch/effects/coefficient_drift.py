"""A discharge coefficient that changes slowly."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale

SMALL = 1e-4


class CoefficientDrift(Effect):
    """The flow is q (1 + r (1 - exp(-b t))/b), or q (1 + r t) for b = 0, with t since the recording's start: deposits
    that grow, water that warms up. The change slows down for b > 0 and accelerates for b < 0.

    Typical: r of 2 to 30 % per hour, either sign; b up to a few over the recording's length. Nearly the same as
    plugging in a short recording.
    """

    name = "coefficient_drift"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("unmetered_flow", "plugging", "sensor_drift", "flow_exponent")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        rate, slowing, settled = (share / time_scale(plant) for share in (3e-4, -5e-4, 1e-2))
        return (
            Parameter("rate", "1/s", 0.0, -rate, rate, meaning="initial relative growth of the flow per second"),
            Parameter("settling", "1/s", 0.0, slowing, settled, meaning="rate at which the change settles"),
        )

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * torch.clamp(1.0 + p["rate"] * elapsed(local.clock.middle, p["settling"]), min=0.0)


def elapsed(time: torch.Tensor, settling: torch.Tensor) -> torch.Tensor:
    """(1 - exp(-b t))/b, s; the series t (1 - b t/2 + (b t)^2/6) for small b t, where the difference would cancel."""
    x = settling * time
    small = x.abs() < SMALL
    safe = torch.where(small, torch.ones_like(x), x)
    return time * torch.where(small, 1.0 - 0.5 * x + x * x / 6.0, (1.0 - torch.exp(-safe)) / safe)
