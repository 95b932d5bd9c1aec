"""A plant as the right-hand side of an ordinary differential equation, as torchdiffeq and other solvers take it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.plant.signals import Clock
from fdi_torch.recording import Recording

RESOLUTION = 0.01  # of roots and rims, in units of the plant's time scale
INSTANT = 1e-3  # s; effects that act from an instant on are averaged over so long about the time asked for

Inputs = Recording | Tensor | Callable[[Tensor], Tensor]
"""A recording, whose inputs run as it holds them; constant inputs (channels,); or a function of time (s) to these."""


class PlantOde(nn.Module):
    """dh/dt = f(t, h) in m/s: levels h (*batch, tanks) in m at the time t () in s, as `torchdiffeq.odeint` calls it.

    network: the plant. space, theta (*batch, P): constants and effects that differ from their nominal values. inputs:
    in SI, one for each of the plant's channels in their order. resolution: s, how sharply roots and rims are drawn.
    Gradients reach theta and h through every call. A new theta wants a new PlantOde.

    Raises ValueError for an actuator that remembers or acts late: its command is no function of t alone.
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
                f"expected actuators whose command is a function of time alone, got {', '.join(names)}, which remember "
                "or act late; leave them out, or use an engine of fdi_torch.set_up"
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
        wanted = [channels[channel] for _, channel in self.network.actuators()]
        commands, _ = self.network.commands(wanted, (), clock, self._values)
        full = [c.expand(levels.shape[:-1]) if c.dim() <= levels.dim() - 1 else c for c in commands]
        held = torch.stack(full, dim=-1) if full else levels.new_zeros(*levels.shape[:-1], 0)
        rates: Tensor = self.network(levels, held, clock, self._values)
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
    """The inputs (channels,) of a recording at a time on its clock from 0 s on; the first and the last hold on."""
    time, values = recording.time - recording.time[0], recording.inputs

    def at(t: Tensor) -> Tensor:
        if recording.hold == "zero_order":
            return values[int((torch.searchsorted(time, t.detach(), right=True) - 1).clamp(0, len(time) - 1))]
        right = int(torch.searchsorted(time, t.detach()).clamp(1, len(time) - 1))
        share = ((t - time[right - 1]) / (time[right] - time[right - 1])).clamp(0.0, 1.0)
        return values[right - 1] + share * (values[right] - values[right - 1])

    return at
