"""A plant advanced from one sample to the next: the model inside every observer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.autograd import forward_ad

from fdi_torch.capacity import expect_room
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.forward_mode import ZeroSlopes

# In units of the plant's time scale. RK4 with this step has an error of 1e-3 cm on three_tank, far below sensor
# resolution.
_USUAL_STEP = 1.0


def usual_step(plant: PlantDescription) -> float:
    """Longest integration step of an observer, s, where none is given."""
    return _USUAL_STEP * time_scale(plant)


@dataclass(frozen=True)
class PlantState:
    """Integrated states (*batch, order) in m, the tanks' levels first, and the memory of actuators and sensors."""

    levels: Tensor
    commands: Memory = ()
    readings: Memory = ()


class Stepper:
    """Integrator of a plant over a sampling interval by RK4 (3/8 rule), in steps up to `longest` s (None:
    `usual_step`).

    Held inputs are exact; linearly interpolated ones are averaged over each step. Raises ValueError for a plant with
    pure delays, whose past is not part of the state.
    """

    def __init__(self, network: TankNetwork, longest: float | None = None) -> None:
        longest = usual_step(network.description) if longest is None else longest
        if not longest > 0:
            raise ValueError(f"expected a positive integration step, got {longest:g} s")
        delayed = [p.prefix for p in network.placements if p.effect.delays]
        if delayed:
            raise ValueError(f"expected a plant without pure delays, got {delayed[0]}; observe it without that effect")
        self.network, self.longest = network, longest

    def start(self, levels: Tensor, inputs: Tensor, values: PlaceValues) -> PlantState:
        """The state at these levels (*batch, tanks) with effects, actuators and sensors in steady state under constant
        inputs (*batch, channels); levels (*batch, order) have the effects' states already.
        """
        clock = self._clock(levels, 0.0, self.longest, self.longest)
        channels = self._channels(inputs)
        seen = self._seen(levels)
        commands = self.network.steady_command_memory(channels, clock, values) if channels else ()
        if levels.shape[-1] < self.network.order:
            actual, _ = self.network.commands(channels, commands, clock, values)
            state = self.network.with_steady_states(levels.unbind(-1), actual, clock, values)
            levels = torch.stack(torch.broadcast_tensors(*state), dim=-1)
        return PlantState(levels, commands, self.network.steady_reading_memory(seen, clock, values))

    def advance(
        self,
        state: PlantState,
        inputs: Callable[[float], Tensor],
        begin: float,
        span: float,
        values: PlaceValues,
    ) -> PlantState:
        """The state `span` s later. inputs: share (0..1) of the span -> (*batch, channels)."""
        for start, step, share in substeps(begin, span, self.longest):
            clock = self._clock(state.levels, start, step, step)
            actual, memory = self.network.commands(self._channels(inputs(share)), state.commands, clock, values)
            state = replace(state, levels=self._runge_kutta(state.levels, actual, clock, values), commands=memory)
        return state

    def read(self, state: PlantState, end: float, span: float, values: PlaceValues) -> tuple[Tensor, PlantState]:
        """Readings (*batch, sensors) at the end of an interval of `span` s, and the state with new sensor memory."""
        clock = self._clock(state.levels, end - span, span, span)
        readings, memory = self.network.read(self._seen(state.levels), state.readings, clock, values)
        return torch.stack(torch.broadcast_tensors(*readings), dim=-1), replace(state, readings=memory)

    def _runge_kutta(self, levels: Tensor, commands: list[Tensor], clock: Clock, values: PlaceValues) -> Tensor:
        step = clock.step

        def rates(x: Tensor) -> Tensor:
            slopes = self.network.rates(x.unbind(-1), commands, clock, values)
            return torch.stack(torch.broadcast_tensors(*slopes), dim=-1)

        k1 = rates(levels)
        k2 = rates(levels + step * k1 / 3)
        k3 = rates(levels + step * (k2 - k1 / 3))
        k4 = rates(levels + step * (k1 - k2 + k3))
        return levels + step * (k1 + 3 * (k2 + k3) + k4) / 8

    def _channels(self, inputs: Tensor) -> list[Tensor]:
        return [inputs[..., channel] for _, channel in self.network.actuators()]

    def _seen(self, levels: Tensor) -> list[Tensor]:
        return [levels[..., tank] for tank in self.network.sensor_tanks()]

    @staticmethod
    def _clock(like: Tensor, start: float, step: float, resolution: float) -> Clock:
        return Clock(like.new_tensor(start), like.new_tensor(step), like.new_tensor(resolution))


def substeps(begin: float, span: float, longest: float) -> list[tuple[float, float, float]]:
    """Start (s), length (s) and middle (as a share of the span) of the equal steps that fill a span."""
    needed = span / longest
    expect_room(
        3.0 * needed, f"{needed:.3g} integration steps of {longest:g} s through {span:g} s", "lengthen the step"
    )
    count = max(math.ceil(needed - 1e-9), 1)
    step = span / count
    return [(begin + i * step, step, (i + 0.5) / count) for i in range(count)]


def slopes(function: Callable[[Tensor], Tensor], point: Tensor) -> Tensor:
    """Forward-mode Jacobian (*batch, out, in) of a lane-wise function (*batch, in) -> (*batch, out).

    The function gives tensors that it does not compute from its argument slopes of zero, see `forward_mode.py`.
    """
    width = point.shape[-1]
    tangents = torch.eye(width, dtype=point.dtype, device=point.device)
    tangents = tangents.reshape(width, *[1] * (point.dim() - 1), width).expand(width, *point.shape)
    with forward_ad.dual_level(), ZeroSlopes():
        dual = forward_ad.make_dual(point.expand(width, *point.shape).contiguous(), tangents.contiguous())
        value, slope = forward_ad.unpack_dual(function(dual))
    slope = torch.zeros_like(value) if slope is None else slope
    return slope.movedim(0, -1)
