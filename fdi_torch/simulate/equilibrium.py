"""The levels at which a plant rests under constant inputs."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.plant.signals import Clock

# In units of the plant's time and length scales.
RESOLUTION = 1e-3  # draws the roots sharply, see plant.orifice.regular_width
AT_REST = 1e-12


def equilibrium(network: TankNetwork, inputs: Tensor, start: Tensor | None = None) -> Tensor:
    """Levels (tanks,) in m at which dh/dt = 0 for constant inputs (channels,) and nominal constants.

    Pseudo-transient continuation (Kelley & Keyes 1998): implicit Euler whose step doubles until it is Newton's.
    Raises ValueError where the plant comes to no rest, for example an outlet too small without a rim to run over.
    """
    values = network.bind(ParameterSpace(), inputs.new_zeros(0))
    plant = network.description
    pace, still = time_scale(plant), AT_REST * length_scale(plant) / time_scale(plant)
    clock = Clock(inputs.new_zeros(()), inputs.new_tensor(pace), inputs.new_tensor(RESOLUTION * pace))
    channels = [inputs[channel] for _, channel in network.actuators()]
    actual, _ = network.commands(channels, network.steady_command_memory(channels, clock, values), clock, values)
    commands = torch.stack(list(actual)) if actual else inputs.new_zeros(0)

    def rates(levels: Tensor) -> Tensor:
        return network(levels, commands, clock, values)

    heights = inputs.new_tensor([tank.height for tank in plant.tanks])
    levels = 0.5 * heights if start is None else start.clone()
    step, eye = pace, torch.eye(len(heights), dtype=inputs.dtype, device=inputs.device)
    for _ in range(200):
        slope = rates(levels)
        if bool((slope.abs() < still).all()):
            return levels
        jacobian = torch.autograd.functional.jacobian(rates, levels)
        move = torch.linalg.solve(eye / step - jacobian, slope)
        levels = torch.clamp(levels + move, min=0.0)
        step = min(2.0 * step, 1e9 * pace)
    worst = int(rates(levels).abs().argmax())
    name = plant.tanks[worst].name
    raise ValueError(
        f"plant {plant.name}: expected a steady state under the first inputs, got tank {name} still "
        "moving; give its start_level"
    )
