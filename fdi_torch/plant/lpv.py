"""The parameter-linear form x' = F(x) theta + B u of a plant (2020 paper, eq. 32, 33), from its right-hand side."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.signals import Clock


def lpv_form(
    network: TankNetwork, space: ParameterSpace, levels: Tensor, commands: Tensor, clock: Clock
) -> tuple[Tensor, Tensor]:
    """F (tanks, P) and B (tanks, actuators) at levels (tanks,) and commands (actuators,).

    The right-hand side is affine in sizes of leaks, net outlets and openness, and in commands within the pumps' limits,
    so that F theta + B u reproduces it wherever no tank is empty or at its rim.
    """

    def rates(theta: Tensor, u: Tensor) -> Tensor:
        return network(levels, u, clock, network.bind(space, theta))

    return torch.autograd.functional.jacobian(rates, (space.nominal(levels), commands))
