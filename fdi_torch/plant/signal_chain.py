"""The series connection of all effects that act on one signal: a command on its way to the actuator, or a reading."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from torch import Tensor

from fdi_torch.plant.effect import Effect, Memory, Placement, Stage, Values
from fdi_torch.plant.operating_point import PlaceValues
from fdi_torch.plant.signals import Clock


class SignalChain:
    """The effects of one stage (COMMAND or READING) at each of `places`, in series; one signal per place.

    memory: total number of memory states of these effects.
    """

    def __init__(self, stage: Stage, places: Iterable[str], placements: Sequence[Placement]) -> None:
        self._is_command = stage is Stage.COMMAND
        self._placed = [[p for p in placements if p.location == at and p.effect.stage is stage] for at in places]
        self.memory = sum(placement.effect.memory for placed in self._placed for placement in placed)

    def propagate(
        self, signals: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        """Pass each place's signal (*batch) through its effects over one step; return the outputs and new memories."""
        outputs: list[Tensor] = []
        new_memory: list[Tensor] = []
        old_memory = list(memory)
        for place, value in enumerate(signals):
            for effect, p in self._effects(place, values):
                value, states = self._apply(effect, value, tuple(old_memory[: effect.memory]), clock, p)
                del old_memory[: effect.memory]
                new_memory.extend(states)
            outputs.append(value)
        return outputs, tuple(new_memory)

    def steady_memory(self, signals: Sequence[Tensor], clock: Clock, values: PlaceValues) -> Memory:
        """The memories in steady state, after the signals have been constant for a long time."""
        states: list[Tensor] = []
        for place, value in enumerate(signals):
            for effect, p in self._effects(place, values):
                memory = effect.steady_memory(value, p)
                value, _ = self._apply(effect, value, memory, clock, p)
                states.extend(memory)
        return tuple(states)

    def delays(self, values: PlaceValues) -> dict[int, Tensor]:
        """Total dead time of each place's signal, s, by index of the place; only places with a delay effect."""
        delays: dict[int, Tensor] = {}
        for place in range(len(self._placed)):
            for effect, p in self._effects(place, values):
                if effect.delays:
                    delays[place] = delays[place] + effect.delay(p) if place in delays else effect.delay(p)
        return delays

    def _effects(self, place: int, values: PlaceValues) -> Iterator[tuple[Effect, Values]]:
        return ((placement.effect, values[placement.prefix]) for placement in self._placed[place])

    def _apply(self, effect: Effect, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return (effect.command if self._is_command else effect.reading)(value, memory, clock, p)
