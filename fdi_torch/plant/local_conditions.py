"""The conditions at one place of a plant at one instant, which flow laws and effects are computed from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from fdi_torch.plant.orifice import signed_root
from fdi_torch.plant.signals import Clock

Values = Mapping[str, "torch.Tensor"]


@dataclass(frozen=True)
class Local:
    """The conditions at one place at one instant. All (*batch), SI.

    level: of the tank (pump: its target; other flows: their source); far_level: at the other end; head: driving head of
    the flow; capacity: flow at 1 m of head (tank: through its leak reference), m^2.5/s, weir m^1.5/s; command: of the
    pump or transfer, or opening of the valve; net: net inflow of the tank so far, m^3/s (BALANCE, and flows that depend
    on it; elsewhere 0); width: head below which square roots are smoothed, m; height: of the tank, floor to rim, m;
    area: of the tank, m^2; gravity: m/s^2; constants: the component's constants by field name; states: of the effect
    that is evaluated, m (see `Effect.states`).
    """

    clock: Clock
    level: torch.Tensor
    far_level: torch.Tensor
    head: torch.Tensor
    capacity: torch.Tensor
    command: torch.Tensor
    net: torch.Tensor
    width: torch.Tensor
    height: torch.Tensor
    area: torch.Tensor
    gravity: torch.Tensor
    constants: Values
    states: tuple[torch.Tensor, ...] = ()

    def root(self, head: torch.Tensor) -> torch.Tensor:
        """Regularised signed square root of a head, sgn(x) sqrt(|x|), m^0.5 (see `signed_root`)."""
        return signed_root(head, self.width)

    def magnitude(self, head: torch.Tensor) -> torch.Tensor:
        """|head| smoothed at zero to sqrt(x^2 + w^2), so that it can be a divisor, m."""
        return torch.sqrt(head * head + self.width * self.width)
