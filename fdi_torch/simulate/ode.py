"""A plant as the right-hand side of an ordinary differential equation, for torchdiffeq and other solvers."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.plant.signals import Clock
from fdi_torch.recording import Recording

RESOLUTION = 0.01  # smoothing of square roots and rims, in units of the plant's time scale
INSTANT = 1e-3  # s; time-dependent effects are averaged over this interval about t

Inputs = Recording | Tensor | Callable[[Tensor], Tensor]
"""A recording, whose inputs are used with its hold; constant inputs (channels,); or a function of time (s) to them."""


class PlantOde(nn.Module):
    """dh/dt = f(t, h) in m/s: levels h (*batch, tanks) in m at the time t () in s, as `torchdiffeq.odeint` calls it.

    network: the plant. space, theta (*batch, P): constants and effects that differ from their nominal values. inputs:
    SI, one per input channel of the plant, in its order. resolution: time scale of the smoothing of square roots and
    rims, s. Gradients flow to theta and h through every call; a new theta needs a new PlantOde.

    Raises ValueError for an actuator with memory or dead time, whose output is not a function of t alone.
    """

    def __init__(
        self,
        network: TankNetwork,
        inputs: Inputs,
        space: ParameterSpace | None = None,
        theta: Tensor | None = None,
        *,
        resolution: float | None = None,
    ) -> None:
        super().__init__()
        space = space or ParameterSpace()
        like = network.nominal
        self.network = network
        self._values = network.bind(space, like.new_zeros(0) if theta is None else theta)
        delayed = bool(network.command_delays(self._values))
        if network.command_memory() or delayed:
            names = sorted({p.prefix for p in network.placements if p.effect.stage.value == "command"})
            raise ValueError(
                f"expected actuators without memory or dead time, got {', '.join(names)}; leave them out, or use an "
                "engine of fdi_torch.set_up"
            )
        self._resolution = like.new_tensor(resolution or RESOLUTION * time_scale(network.description))
        self._inputs = _function_of_time(inputs, network, like)

    @property
    def start(self) -> Tensor:
        """The plant's start levels (*batch, tanks), m."""
        return torch.stack(torch.broadcast_tensors(*self.network.start_levels(self._values)), dim=-1)

    def forward(self, t: Tensor, levels: Tensor) -> Tensor:
        instant = torch.as_tensor(t).to(levels)
        clock = Clock(instant - 0.5 * INSTANT, torch.full_like(instant, INSTANT), self._resolution.to(levels))
        channels = self._inputs(instant).unbind(-1)
        actuator_inputs = [channels[channel] for _, channel in self.network.actuators()]
        commands, _ = self.network.commands(actuator_inputs, (), clock, self._values)
        expanded = [c.expand(levels.shape[:-1]) if c.dim() <= levels.dim() - 1 else c for c in commands]
        stacked = torch.stack(expanded, dim=-1) if expanded else levels.new_zeros(*levels.shape[:-1], 0)
        rates: Tensor = self.network(levels, stacked, clock, self._values)
        return rates


def _function_of_time(inputs: Inputs, network: TankNetwork, like: Tensor) -> Callable[[Tensor], Tensor]:
    channels = network.description.channels()
    if isinstance(inputs, Recording):
        return _played(inputs.selected(channels, ()))
    if isinstance(inputs, Tensor):
        if inputs.shape[-1:] != (len(channels),):
            raise ValueError(f"expected inputs of {', '.join(channels)}, got a tensor of shape {tuple(inputs.shape)}")
        constant = inputs.to(like)
        return lambda t: constant
    return inputs


def _played(recording: Recording) -> Callable[[Tensor], Tensor]:
    """The inputs (channels,) of a recording as a function of the time since its start, constant before and after it."""
    time, values = recording.time - recording.time[0], recording.inputs

    def at(t: Tensor) -> Tensor:
        if recording.hold == "zero_order":
            return values[int((torch.searchsorted(time, t.detach(), right=True) - 1).clamp(0, len(time) - 1))]
        right = int(torch.searchsorted(time, t.detach()).clamp(1, len(time) - 1))
        share = ((t - time[right - 1]) / (time[right] - time[right - 1])).clamp(0.0, 1.0)
        return values[right - 1] + share * (values[right] - values[right - 1])

    return at
