"""A plant as the right-hand side of an ordinary differential equation, for torchdiffeq and other solvers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.plant.signals import Clock
from fdi_torch.recording import Recording
from fdi_torch.simulate.equilibrium import equilibrium

# In units of the plant's time scale.
RESOLUTION = 0.01  # smoothing of square roots and rims
INSTANT = 1e-3  # time-dependent effects are averaged over this interval about t

Inputs = Recording | Tensor | Sequence[float] | Callable[[Tensor], Tensor]
"""A recording, whose inputs are used with its hold; constant inputs (channels,); or a function of time (s) to them."""


class PlantOde(nn.Module):
    """dx/dt = f(t, x) in m/s: the state x (*batch, order) in m at the time t () in s, as `torchdiffeq.odeint` calls it.

    The state holds the tanks' levels and then the states of effects, such as the flow of a pipe with inertia.

    network: the plant. space, theta (*batch, P): constants and effects that differ from their nominal values. inputs:
    SI, one per input channel of the plant, in its order. Gradients flow to theta and x through every call; a new theta
    needs a new PlantOde. The device is that of theta, else that of the inputs.

    Raises ValueError for an actuator with memory or dead time, whose output is not a function of t alone.
    """

    def __init__(
        self,
        network: TankNetwork,
        inputs: Inputs,
        space: ParameterSpace | None = None,
        theta: Tensor | None = None,
    ) -> None:
        super().__init__()
        space = space or ParameterSpace()
        self.network = network.to(_device_of(inputs, theta, network))
        like = self.network.nominal
        self._given = frozenset(space.names)
        self._values = network.bind(space, like.new_zeros(0) if theta is None else theta)
        delayed = bool(network.command_delays(self._values))
        if network.command_memory or delayed:
            names = sorted({p.prefix for p in network.placements if p.effect.stage.value == "command"})
            raise ValueError(
                f"expected actuators without memory or dead time, got {', '.join(names)}; leave them out, or use an "
                "engine of fdi_torch.set_up"
            )
        scale = time_scale(network.description)
        self._instant, self._resolution = INSTANT * scale, like.new_tensor(RESOLUTION * scale)
        self._inputs = _function_of_time(inputs, network, like)

    @property
    def start(self) -> Tensor:
        """The state at t = 0 (*batch, order), m, at which `fdi_torch.simulate` starts: the start levels of theta and of
        the plant, for other tanks the equilibrium at nominal constants under the first inputs; effects in steady state.
        """
        levels = self.network.start_levels(self._values)
        tanks = self.network.description.tanks
        at_rest = [t.start_level is None and f"{t.name}.start_level" not in self._given for t in tanks]
        if any(at_rest):
            first = self._inputs(self.network.nominal.new_zeros(())).detach()
            rest = equilibrium(self.network, first).unbind(-1)
            levels = [r if is_at_rest else h for r, h, is_at_rest in zip(rest, levels, at_rest, strict=True)]
        state = self.network.with_steady_states(levels, *self._driven(levels[0].new_zeros(())), self._values)
        return torch.stack(torch.broadcast_tensors(*state), dim=-1)

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        commands, clock = self._driven(torch.as_tensor(t).to(state))
        expanded = [c.expand(state.shape[:-1]) if c.dim() <= state.dim() - 1 else c for c in commands]
        stacked = torch.stack(expanded, dim=-1) if expanded else state.new_zeros(*state.shape[:-1], 0)
        rates: Tensor = self.network(state, stacked, clock, self._values)
        return rates

    def _driven(self, instant: Tensor) -> tuple[list[Tensor], Clock]:
        """Outputs of the actuators at an instant, s, and the clock there."""
        step = torch.full_like(instant, self._instant)
        clock = Clock(instant - 0.5 * step, step, self._resolution.to(instant))
        channels = self._inputs(instant).unbind(-1)
        actuator_inputs = [channels[channel] for _, channel in self.network.actuators()]
        return self.network.commands(actuator_inputs, (), clock, self._values)[0], clock


def _device_of(inputs: Inputs, theta: Tensor | None, network: TankNetwork) -> torch.device:
    given = theta if theta is not None else inputs.time if isinstance(inputs, Recording) else inputs
    return given.device if isinstance(given, Tensor) else network.nominal.device


def _function_of_time(inputs: Inputs, network: TankNetwork, like: Tensor) -> Callable[[Tensor], Tensor]:
    channels = network.description.channels()
    if isinstance(inputs, Recording):
        return _inputs_over_time(inputs.selected(channels, ()))
    if not callable(inputs):
        constant = torch.as_tensor(inputs, dtype=like.dtype, device=like.device)
        if constant.shape[-1:] != (len(channels),):
            raise ValueError(f"expected inputs of {', '.join(channels)}, got a tensor of shape {tuple(constant.shape)}")
        return lambda t: constant
    return inputs


def _inputs_over_time(recording: Recording) -> Callable[[Tensor], Tensor]:
    """The inputs (channels,) of a recording as a function of the time since its start, constant before and after it."""
    time, values = recording.time - recording.time[0], recording.inputs

    def at(t: Tensor) -> Tensor:
        if recording.hold == "zero_order":
            return values[int((torch.searchsorted(time, t.detach(), right=True) - 1).clamp(0, len(time) - 1))]
        right = int(torch.searchsorted(time, t.detach()).clamp(1, len(time) - 1))
        share = ((t - time[right - 1]) / (time[right] - time[right - 1])).clamp(0.0, 1.0)
        return values[right - 1] + share * (values[right] - values[right - 1])

    return at
