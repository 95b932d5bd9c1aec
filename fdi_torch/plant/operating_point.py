"""The operating point of a plant: levels, commands and constants at one instant, and the conditions at each place."""

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
    """The constants of a plant by place and field, with a cache for quantities that depend on them alone."""

    def __init__(self, values: PlaceValues) -> None:
        super().__init__(values)
        self._cache: dict[str, tuple[object, Tensor]] = {}

    def cached(self, name: str, compute: Callable[[], Tensor], key: object = None) -> Tensor:
        """Return `compute()`, reusing the last result under `name` while `key` is the same object.

        Results that require gradients are not cached, because autograd can go back through their graph only once.
        """
        last_key, value = self._cache.get(name, (self, None))
        if value is not None and last_key is key:
            return value
        value = compute()
        if not value.requires_grad:
            self._cache[name] = key, value
        return value


@dataclass(frozen=True)
class OperatingPoint:
    """Levels (m) of the tanks and commands after the actuators' effects, in one step of the clock; all (*batch), SI."""

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
    ) -> OperatingPoint:
        by_tank = dict(zip((tank.name for tank in plant.tanks), levels, strict=True))
        constants = values if isinstance(values, Constants) else Constants(values)
        return cls(plant, by_tank, dict(zip(actuators, commands, strict=True)), clock, constants)

    @property
    def gravity(self) -> Tensor:
        return self.values[""]["gravity"]

    def at_pump(self, pump: Pump) -> Local:
        """Conditions at a pump: the level of its target tank, the pump's gain and command."""
        constants = self.values[pump.name]
        at_target = self.at_tank(pump.target)
        return replace(at_target, capacity=constants["gain"], command=self.commands[pump.name], constants=constants)

    def at_pipe(self, pipe: Pipe) -> Local:
        """Conditions at a pipe or outlet: both levels, the head between them, the valve's opening."""
        constants = self.values[pipe.name]
        level = self.levels[pipe.source]
        head, far = level - constants["elevation"], level
        if not pipe.is_outlet:
            far = self.levels[pipe.target]
            wet_far = torch.clamp(far - constants["elevation"], min=0.0)
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
            constants=constants,
        )

    def at_tank(self, name: str, far: str | None = None, net: Tensor | None = None) -> Local:
        """Conditions at a tank, or between a tank and `far`; net: inflow of the tank so far, m^3/s."""
        constants, level = self.values[name], self.levels[name]
        return Local(
            self.clock,
            level,
            self.levels[far or name],
            head=level,
            capacity=constants["leak_capacity"],
            command=level,
            net=self._number(0.0) if net is None else net,
            width=self.width(leak_pipe(self.plant, name)),
            height=constants["height"],
            gravity=self.gravity,
            constants=constants,
        )

    def capacity(self, pipe: Pipe) -> Tensor:
        """C_d a sqrt(2 g) of a pipe: its flow at 1 m of head, m^2.5/s."""
        constants = self.values[pipe.name]
        return self.values.cached(
            f"capacity of {pipe.name}",
            lambda: orifice_capacity(constants["discharge_coefficient"], constants["area"], self.gravity),
        )

    def width(self, pipe: Pipe) -> Tensor:
        """Head below which the square root of a pipe's law is smoothed, m."""

        def compute() -> Tensor:
            rate = nominal_capacity(self.plant, pipe) * inverse_areas(self.plant, pipe)
            return regular_width(rate, self.clock.resolution)

        return self.values.cached(f"width of {pipe.name}", compute, self.clock.resolution)

    def rim(self, tank: Tank) -> Tensor:
        """Weir coefficient of a tank's whole rim: its overflow at 1 m above the rim, m^1.5/s."""
        constants = self.values[tank.name]
        return self.values.cached(f"rim of {tank.name}", lambda: rim_strength(constants["area"], self.gravity))

    def _number(self, value: float) -> Tensor:
        return self.values.cached(f"the number {value}", lambda: torch.full_like(self.gravity, value))
