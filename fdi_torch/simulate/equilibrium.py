"""The steady state of a plant under constant inputs."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.plant.signals import Clock

# In units of the plant's time and length scales.
RESOLUTION = 1e-3  # little smoothing of square roots, see plant.orifice.regular_width
AT_REST = 1e-12
MOST_STEPS = 200


def equilibrium(network: TankNetwork, inputs: Float[Tensor, " channels"]) -> Float[Tensor, " tanks"]:
    """Levels (tanks,), m, at which dh/dt = 0 for constant inputs (channels,) and nominal constants.

    Pseudo-transient continuation (Kelley and Keyes, 1998): implicit Euler steps that double until they equal Newton's.
    Along the true trajectory, the sum of the tanks' absolute rates of volume never grows (Jacquez and Simon, 1993). A
    step after which this sum has grown, as of Newton's method across the kink at equal levels, is repeated with a
    quarter of its length.
    Raises ValueError if none is found.
    """
    values = network.bind(ParameterSpace(), inputs.new_zeros(0))
    plant = network.description
    scale, rest_rate = time_scale(plant), AT_REST * length_scale(plant) / time_scale(plant)
    clock = Clock(inputs.new_zeros(()), inputs.new_tensor(scale), inputs.new_tensor(RESOLUTION * scale))
    channels = [inputs[channel] for _, channel in network.actuators()]
    outputs, _ = network.commands(channels, network.steady_command_memory(channels, clock, values), clock, values)
    commands = torch.stack(list(outputs)) if outputs else inputs.new_zeros(0)

    def rates(levels: Tensor) -> Tensor:
        return network(levels, commands, clock, values)[: len(plant.tanks)]  # effects with states are in steady state

    heights = inputs.new_tensor([tank.height for tank in plant.tanks])
    levels = 0.5 * heights
    step, eye = scale, torch.eye(len(heights), dtype=inputs.dtype, device=inputs.device)
    areas, rate = inputs.new_tensor([tank.area for tank in plant.tanks]), rates(levels)
    for _ in range(MOST_STEPS):
        if bool((rate.abs() < rest_rate).all()):
            return levels
        jacobian = torch.autograd.functional.jacobian(rates, levels)
        further = torch.clamp(levels + torch.linalg.solve(eye / step - jacobian, rate), min=0.0)
        rate_there = rates(further)
        if bool((areas * rate_there.abs()).sum() > (areas * rate.abs()).sum()):
            step /= 4.0
        else:
            levels, rate, step = further, rate_there, min(2.0 * step, 1e9 * scale)
    worst = int(rate.abs().argmax())
    name = plant.tanks[worst].name
    raise ValueError(
        f"{plant.title}: expected a steady state under the first inputs, but the level of tank {name} keeps "
        "changing; give its start_level"
    )
