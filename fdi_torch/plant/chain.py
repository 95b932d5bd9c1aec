"""What a signal goes through at each of some places: the effects put there, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from torch import Tensor

from fdi_torch.plant.effect import Effect, Memory, Placement, Stage, Values
from fdi_torch.plant.moment import PlaceValues
from fdi_torch.plant.signals import Clock


class SignalChain:
    """The effects of a stage (COMMAND or READING) at `places`, one signal each. memory: how many they keep in all."""

    def __init__(self, stage: Stage, places: Iterable[str], placements: Sequence[Placement]) -> None:
        self._is_command = stage is Stage.COMMAND
        self._placed = [[p for p in placements if p.location == at and p.effect.stage is stage] for at in places]
        self.memory = sum(placement.effect.memory for placed in self._placed for placement in placed)

    def through(
        self, signals: Sequence[Tensor], memory: Memory, clock: Clock, values: PlaceValues
    ) -> tuple[list[Tensor], Memory]:
        """What comes out of each place over a step, and the memories after it."""
        outcomes: list[Tensor] = []
        remembered: list[Tensor] = []
        rest = list(memory)
        for place, value in enumerate(signals):
            for effect, p in self._effects(place, values):
                value, kept = self._apply(effect, value, tuple(rest[: effect.memory]), clock, p)
                del rest[: effect.memory]
                remembered.extend(kept)
            outcomes.append(value)
        return outcomes, tuple(remembered)

    def settled(self, signals: Sequence[Tensor], clock: Clock, values: PlaceValues) -> Memory:
        """The memories after the signals have long been what they are."""
        remembered: list[Tensor] = []
        for place, value in enumerate(signals):
            for effect, p in self._effects(place, values):
                memory = effect.remember(value, p)
                value, _ = self._apply(effect, value, memory, clock, p)
                remembered.extend(memory)
        return tuple(remembered)

    def delays(self, values: PlaceValues) -> dict[int, Tensor]:
        """By how many seconds a place (index) is late; only those that can be."""
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
