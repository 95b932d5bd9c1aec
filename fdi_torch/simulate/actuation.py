"""Actuator outputs over a whole experiment, and their slopes by the parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.parameters import by_prefix
from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.linearised_stage import Row, Signals, linearise_stage, partials, solve_memory


@dataclass(frozen=True)
class Actuation:
    """The actuators of a plant in one experiment. names: the parameters by which outputs are differentiated."""

    network: TankNetwork
    experiment: Experiment
    names: Sequence[str]

    @property
    def clock(self) -> Clock:
        """The clock of all K steps at once."""
        e = self.experiment
        return Clock(e.nodes[:-1], e.steps, e.resolution)

    def commands(self, values: PlaceValues, lanes: int) -> list[Tensor]:
        """Output of each actuator over the K steps, one tensor (L, K) each."""
        signals, count = self._channels(values, lanes), self.network.command_memory
        stage = self._stage(values)
        memory = solve_memory(stage.step, stage.first, signals, [], count, signals[0].shape) if signals else []
        return self.network.commands(signals, tuple(memory), self.clock, values)[0]

    def slopes(
        self, values: PlaceValues, theta: Signals, lanes: int
    ) -> tuple[list[Tensor], list[Tensor | None], list[int]]:
        """Outputs (L, K) of the actuators and their slopes.

        theta: each named parameter (L, 1). Returns the outputs, the slopes (L, M, K) of each output by the M parameters
        that affect any of them (None for an output without slopes), and the indices of these M parameters.
        """
        channels, stage = self._channels(values, lanes), self._stage(values)
        if not channels:
            return [], [], []
        shape = channels[0].shape
        channel_slopes: list[Row] = [[None] * len(theta)] * len(channels)
        if self.network.command_delays(values):
            channel_slopes = partials(
                lambda x: self._channels(with_parameters(values, self.names, x), lanes), theta, shape
            )[1]
        linearised = linearise_stage(stage.step, stage.first, channels, theta, self.network.command_memory, shape)
        by_channel = {p for row in channel_slopes for p, slope in enumerate(row) if slope is not None}
        columns = sorted({*by_channel, *linearised.moved_by()})
        signals = [_columns([row[p] for p in columns]) for row in channel_slopes]
        return linearised.outputs, linearised.along(signals, columns), columns

    def _stage(self, values: PlaceValues) -> NetworkStage:
        return NetworkStage(self.network.commands, self.network.steady_command_memory, self.clock, self.names, values)

    def _channels(self, values: PlaceValues, lanes: int) -> list[Tensor]:
        """Mean of each actuator's channel over each step (L, K), with its dead time."""
        e = self.experiment
        delays = self.network.command_delays(values)
        means = [
            e.signal.average(e.nodes[:-1], e.steps, channel, delays[i]) if i in delays else e.inputs[:, channel]
            for i, (_, channel) in enumerate(self.network.actuators())
        ]
        return [c.expand(lanes, len(e.steps)) for c in means]


@dataclass(frozen=True)
class NetworkStage:
    """The actuators or the sensors of a network as a stage whose parameters `names` are free.

    outputs: computes the outputs and the new memory from the signals, the memory, the clock and the effects' values.
    steady: computes the memory in steady state from the signals, the clock and these values.
    """

    outputs: Callable[[Signals, Memory, Clock, PlaceValues], tuple[Signals, Memory]]
    steady: Callable[[Signals, Clock, PlaceValues], Memory]
    clock: Clock
    names: Sequence[str]
    values: PlaceValues

    def step(self, signals: Signals, memory: Memory, theta: Signals) -> tuple[Signals, Memory]:
        return self.outputs(signals, memory, self.clock, with_parameters(self.values, self.names, theta))

    def first(self, signals: Signals, theta: Signals) -> Memory:
        return self.steady(signals, self.clock.part(slice(1)), with_parameters(self.values, self.names, theta))


def with_parameters(values: PlaceValues, names: Sequence[str], theta: Signals) -> PlaceValues:
    """The values with the named ones replaced by theta; unchanged if theta is empty."""
    if not theta:
        return values
    replaced = {place: dict(fields) for place, fields in values.items()}
    for prefix, fields in by_prefix(dict(zip(names, theta, strict=True))).items():
        replaced[prefix] |= fields
    return replaced


def _columns(slopes: Row) -> Tensor | None:
    like = next((s for s in slopes if s is not None), None)
    if like is None:
        return None
    return torch.stack([torch.zeros_like(like) if s is None else s for s in slopes], dim=1)
