"""What actuators make of their channels over a whole experiment, and how that moves with the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.memory import Signals, chain, remembered
from fdi_torch.simulate.pointwise import Row, partials


@dataclass(frozen=True)
class Actuation:
    """names: of the parameters that may move."""

    network: TankNetwork
    experiment: Experiment
    names: Sequence[str]

    @property
    def clock(self) -> Clock:
        e = self.experiment
        return Clock(e.nodes[:-1], e.steps, e.resolution)

    def commands(self, values: PlaceValues, lanes: int) -> list[Tensor]:
        """Each actuator's command (L, K)."""
        signals, count = self._channels(values, lanes), self.network.command_memory()
        stage = _Stage(self, values)
        memory = remembered(stage.step, stage.first, signals, [], count, signals[0].shape) if signals else []
        return self.network.commands(signals, tuple(memory), self.clock, values)[0]

    def slopes(
        self, values: PlaceValues, theta: Signals, lanes: int
    ) -> tuple[list[Tensor], list[Tensor | None], list[int]]:
        """theta: of each name (L, 1) -> commands (L, K), how each moves (L, M, K), and which M parameters move them."""
        channels, stage = self._channels(values, lanes), _Stage(self, values)
        if not channels:
            return [], [], []
        shape = channels[0].shape
        late: list[Row] = [[None] * len(theta)] * len(channels)
        if self.network.command_delays(values):
            late = partials(lambda x: self._channels(moved(values, self.names, x), lanes), theta, shape)[1]
        found = chain(stage.step, stage.first, channels, theta, self.network.command_memory(), shape)
        by_channel = {p for row in late for p, slope in enumerate(row) if slope is not None}
        columns = sorted({*by_channel, *found.moved_by()})
        signals = [_columns([row[p] for p in columns]) for row in late]
        return found.outputs, found.along(signals, columns), columns

    def _channels(self, values: PlaceValues, lanes: int) -> list[Tensor]:
        """Each actuator's channel averaged over each step, late where it is late, (L, K)."""
        e = self.experiment
        delays = self.network.command_delays(values)
        each = [
            e.signal.average(e.nodes[:-1], e.steps, channel, delays[i]) if i in delays else e.inputs[:, channel]
            for i, (_, channel) in enumerate(self.network.actuators())
        ]
        return [c.expand(lanes, len(e.steps)) for c in each]


@dataclass(frozen=True)
class _Stage:
    of: Actuation
    values: PlaceValues

    def step(self, signals: Signals, memory: Memory, theta: Signals) -> tuple[Signals, Memory]:
        return self.of.network.commands(signals, memory, self.of.clock, moved(self.values, self.of.names, theta))

    def first(self, signals: Signals, theta: Signals) -> Memory:
        clock = self.of.clock
        at_first = Clock(clock.start[:1], clock.step[:1], clock.resolution)
        return self.of.network.steady_command_memory(signals, at_first, moved(self.values, self.of.names, theta))


def moved(values: PlaceValues, names: Sequence[str], theta: Signals) -> PlaceValues:
    """The values with those of the names replaced; as they are where theta is empty."""
    if not theta:
        return values
    own = {place: dict(fields) for place, fields in values.items()}
    for name, value in zip(names, theta, strict=True):
        place, _, field = name.rpartition(".")
        own[place][field] = value
    return own


def _columns(slopes: Row) -> Tensor | None:
    known = next((s for s in slopes if s is not None), None)
    if known is None:
        return None
    return torch.stack([torch.zeros_like(known) if s is None else s for s in slopes], dim=1)
