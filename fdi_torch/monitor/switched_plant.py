"""A plant in which some constants change at one time, at once or linearly over a while."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from fdi_torch.parameters import Parameter, ParameterName, ParameterSpace
from fdi_torch.plant.effect import Memory
from fdi_torch.plant.network import PlaceValues, TankNetwork
from fdi_torch.plant.signals import Clock

ONSET, RAMP = "change.onset", "change.ramp"


class SwitchedNetwork(TankNetwork):
    """Network with c(t) = c + (c_after - c) s(t); s rises from 0 to 1 from `change.onset` within `change.ramp` seconds.

    Each integration step and each sampling interval uses the mean of s over it. An onset between samples therefore
    needs no step of its own, and the readings are continuous in the onset. Initial levels, delays and steady memories
    use the constants before the change.
    """

    def __init__(self, network: TankNetwork, names: Sequence[str]) -> None:
        super().__init__(network.description, network.placements)
        self.names = tuple(names)
        after = [replace(network.constants[name], name=f"after {name}") for name in names]
        change = [Parameter(ONSET, "s", 1e30), Parameter(RAMP, "s", 0.0, 0.0)]
        self.constants = ParameterSpace([*network.constants, *after, *change])
        self.register_buffer("nominal", self.constants.nominal())

    def rates(
        self, state: Sequence[Tensor], commands: Sequence[Tensor], clock: Clock, values: PlaceValues
    ) -> list[Tensor]:
        return super().rates(state, commands, clock, self.values_at(values, clock))

    def commands(
        self, channels: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        return super().commands(channels, memory, clock, self.values_at(values, clock))

    def read(
        self, levels: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        return super().read(levels, memory, clock, self.values_at(values, clock))

    def values_at(self, values: PlaceValues, clock: Clock) -> PlaceValues:
        """Every constant at its mean over the clock's step."""
        share = clock.risen(values["change"]["onset"], values["change"]["ramp"])
        mean = {place: dict(fields) for place, fields in values.items()}
        for name in map(ParameterName.parse, self.names):
            before = values[name.prefix][name.field]
            mean[name.prefix][name.field] = before + (values[f"after {name.prefix}"][name.field] - before) * share
        return mean


def own_onsets(network: TankNetwork, space: ParameterSpace) -> dict[str, str]:
    """Sizes in `space` of effects with a memory and an onset parameter, with the names of these onsets."""
    named = {}
    for placement in network.placements:
        size, *_ = placement.effect.parameters(placement.location, network.description)
        name = placement.full_name(size.name)
        if placement.effect.memory and len(placement.effect.instants) == 1 and name in space:
            named[name] = placement.full_name(placement.effect.instants[0])
    return named
