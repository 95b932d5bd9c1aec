"""A plant some of whose constants change at one moment: at once, or in a straight line over a while."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock

ONSET, RAMP = "change.onset", "change.ramp"


class ChangingNetwork(TankNetwork):
    """c(t) = c + (after c - c) s(t), with s rising from 0 to 1 from `change.onset` on, within `change.ramp` seconds.

    Each step and each sampling interval sees the mean of s over it, so that a moment between samples needs no step of
    its own and readings are continuous in it. Start levels, delays and settled memories are those before the change.
    """

    def __init__(self, network: TankNetwork, names: Sequence[str]) -> None:
        super().__init__(network.description, network.placements)
        self.names = tuple(names)
        after = [replace(network.constants[name], name=f"after {name}") for name in names]
        moment = [Parameter(ONSET, "s", 1e30), Parameter(RAMP, "s", 0.0, 0.0)]
        self.constants = ParameterSpace([*network.constants, *after, *moment])
        self.register_buffer("nominal", self.constants.nominal())

    def rates(
        self, levels: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        return super().rates(levels, commands, clock, self.now(values, clock))

    def commands(
        self, channels: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        return super().commands(channels, memory, clock, self.now(values, clock))

    def read(
        self, levels: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        return super().read(levels, memory, clock, self.now(values, clock))

    def now(self, values: PlaceValues, clock: Clock) -> PlaceValues:
        """Every constant at its mean over a step."""
        share = clock.risen(values["change"]["onset"], values["change"]["ramp"])
        own = {place: dict(fields) for place, fields in values.items()}
        for name in self.names:
            place, _, field = name.rpartition(".")
            before = values[place][field]
            own[place][field] = before + (values[f"after {place}"][field] - before) * share
        return own
