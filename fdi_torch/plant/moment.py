"""A plant at one moment: what holds at each of its places, for the laws that are written over single components."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.plant.constants import inverse_areas, leak_pipe, nominal_capacity
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Tank
from fdi_torch.plant.effect import Local, Values
from fdi_torch.plant.orifice import orifice_capacity, regular_width, rim_strength
from fdi_torch.plant.signals import Clock

PlaceValues = Mapping[str, Values]
"""The constants of a plant by place and field."""


class Constants(dict[str, Values]):
    """The constants of a plant by place and field, and what follows from them alone, worked out once."""

    def __init__(self, values: PlaceValues) -> None:
        super().__init__(values)
        self._known: dict[str, tuple[object, Tensor]] = {}

    def once(self, name: str, work: Callable[[], Tensor], given: object = None) -> Tensor:
        """What `work` gives, kept as long as `given` is the same thing.

        Not kept where gradients are to flow back through it, which they can do once only.
        """
        before, known = self._known.get(name, (self, None))
        if known is not None and before is given:
            return known
        value = work()
        if not value.requires_grad:
            self._known[name] = given, value
        return value


@dataclass(frozen=True)
class Moment:
    """levels (m) of the tanks and commands of the actuators as they act, in the clock's step; all (*batch), SI."""

    plant: PlantDescription
    levels: Mapping[str, Tensor]
    commands: Mapping[str, Tensor]
    clock: Clock
    values: Constants

    @classmethod
    def of(
        cls,
        plant: PlantDescription,
        levels: Sequence[Tensor],
        actuators: Sequence[str],
        commands: Sequence[Tensor],
        clock: Clock,
        values: PlaceValues,
    ) -> Moment:
        by_tank = dict(zip((tank.name for tank in plant.tanks), levels, strict=True))
        known = values if isinstance(values, Constants) else Constants(values)
        return cls(plant, by_tank, dict(zip(actuators, commands, strict=True)), clock, known)

    @property
    def gravity(self) -> Tensor:
        return self.values[""]["gravity"]

    def at_pump(self, pump: Pump) -> Local:
        """At a pump: the level of its target, its own gain and command."""
        own = self.values[pump.name]
        at_target = self.at_tank(pump.target)
        return replace(at_target, capacity=own["gain"], command=self.commands[pump.name], constants=own)

    def at_pipe(self, pipe: Pipe) -> Local:
        """At a pipe or outlet: both levels, the head between them, its opening."""
        own = self.values[pipe.name]
        level = self.levels[pipe.source]
        head, far = level - own["elevation"], level
        if not pipe.is_outlet:
            far = self.levels[pipe.target]
            wet_far = torch.clamp(far - own["elevation"], min=0.0)
            head = torch.clamp(head, min=0.0) - wet_far if pipe.elevation else level - far
        elif pipe.target == OUTSIDE:
            far = torch.zeros_like(level)
        else:
            far = self.levels[pipe.target]
        opening = self.commands.get(pipe.name)
        return Local(
            self.clock,
            level,
            far,
            head,
            capacity=self.capacity(pipe),
            command=self._number(1.0) if opening is None else torch.clamp(opening, 0.0, 1.0),
            net=self._number(0.0),
            width=self.width(pipe),
            height=self.values[pipe.source]["height"],
            gravity=self.gravity,
            constants=own,
        )

    def at_tank(self, name: str, far: str | None = None, net: Tensor | None = None) -> Local:
        """At a tank, or between two: the levels, the capacity of its leak reference, what flows in so far (m^3/s)."""
        own, level = self.values[name], self.levels[name]
        return Local(
            self.clock,
            level,
            self.levels[far or name],
            head=level,
            capacity=own["leak_capacity"],
            command=level,
            net=self._number(0.0) if net is None else net,
            width=self.width(leak_pipe(self.plant, name)),
            height=own["height"],
            gravity=self.gravity,
            constants=own,
        )

    def capacity(self, pipe: Pipe) -> Tensor:
        """Flow at 1 m of head, m^2.5/s."""
        own = self.values[pipe.name]
        return self.values.once(
            f"capacity of {pipe.name}",
            lambda: orifice_capacity(own["discharge_coefficient"], own["area"], self.gravity),
        )

    def width(self, pipe: Pipe) -> Tensor:
        """The head below which the roots of a pipe are drawn smooth, m."""

        def work() -> Tensor:
            rate = nominal_capacity(self.plant, pipe) * inverse_areas(self.plant, pipe)
            return regular_width(rate, self.clock.resolution)

        return self.values.once(f"width of {pipe.name}", work, self.clock.resolution)

    def rim(self, tank: Tank) -> Tensor:
        """What runs over a tank's rim at 1 m above it, as a strength: m^1.5/s."""
        own = self.values[tank.name]
        return self.values.once(f"rim of {tank.name}", lambda: rim_strength(own["area"], self.gravity))

    def _number(self, value: float) -> Tensor:
        return self.values.once(f"the number {value}", lambda: torch.full_like(self.gravity, value))
