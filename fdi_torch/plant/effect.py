"""The socket: what a fault or an unmodelled effect is to the plant.

Both are a deviation of one component, with an equation and parameters that vanish at their nominal value.
An effect overrides the one hook of its stage; every other hook passes its value on unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import Pipe, PlantDescription, Pump, Sensor, Tank
from fdi_torch.plant.orifice import signed_root
from fdi_torch.plant.reach import Reach
from fdi_torch.plant.signals import Clock

Memory = tuple[Tensor, ...]
Values = Mapping[str, Tensor]


class Stage(Enum):
    """Where water meets the effect, in the order it takes."""

    COMMAND = "command"
    FLOW = "flow"
    BALANCE = "balance"
    STORAGE = "storage"
    READING = "reading"


@dataclass(frozen=True)
class Local:
    """What holds at a place at one instant. All (*batch), SI.

    level: of the tank (pump: its target; pipe: its source); far_level: at the other end; head: what drives the flow;
    capacity: flow at 1 m of head through the place's orifice (tank: through its leak reference), m^2.5/s;
    command: of the pump or the valve's opening; net: what flows into the tank so far, m^3/s (BALANCE; elsewhere 0);
    width: the head below which roots are drawn smooth, m; height: of that tank's rim, m; gravity: m/s^2;
    constants: the component's constants by field name.
    """

    clock: Clock
    level: Tensor
    far_level: Tensor
    head: Tensor
    capacity: Tensor
    command: Tensor
    net: Tensor
    width: Tensor
    height: Tensor
    gravity: Tensor
    constants: Values

    def root(self, head: Tensor) -> Tensor:
        """The signed square root of a head, regularised."""
        return signed_root(head, self.width)

    def magnitude(self, head: Tensor) -> Tensor:
        """|head|, rounded off at zero so that it can be divided by: sqrt(x^2 + w^2)."""
        return torch.sqrt(head * head + self.width * self.width)


class Effect:
    """Base of all faults and unmodelled effects.

    name: as in configs and answers. stage: which hook it overrides. places: the kinds of component it can sit at,
    of 'pump', 'pipe', 'outlet', 'valve', 'tank', 'tank_pair', 'sensor'. memory: how many memory states it keeps.
    smooth: whether the size's gradient at nominal is not zero. mistaken_for: effects that explain nearly the same data.
    delays, rounds: whether it makes the signal late, or the reading coarse. at_first: whether it acts only until its
    component has run for the first time. of_build: whether it comes with how a component is built, so that one of the
    same make is expected to have it too. on_clock: parameters that tie it to the clock of one recording where they are
    fitted (a moment, a phase, a pace since the start).
    The first of its parameters is its size: where that is nominal, the effect is not there. The others are its
    shape: nominal there is a typical value, or one (an onset of 0, a ramp of 0) that keeps the effect simple.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    places: ClassVar[tuple[str, ...]]
    memory: ClassVar[int] = 0
    smooth: ClassVar[bool] = True
    delays: ClassVar[bool] = False
    rounds: ClassVar[bool] = False
    at_first: ClassVar[bool] = False
    of_build: ClassVar[bool] = False
    on_clock: ClassVar[tuple[str, ...]] = ("onset",)
    mistaken_for: ClassVar[tuple[str, ...]] = ()

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        """Its parameters at that place, size first, under their own short names; ranges may follow the component."""
        raise NotImplementedError

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        """Where a fit may begin (SI, short names). A start names what is to be fitted; the rest stays nominal.

        Here: a tenth of the size's range in each direction, the shape as it is. Effects with a threshold, which no
        gradient finds, return a small grid over what the recording reaches.
        """
        size, *shape = self.parameters(place, plant)
        typical = {p.name: p.nominal for p in shape}
        bounds = [bound for bound in (size.low, size.high) if bound != size.nominal]
        return [{size.name: size.nominal + 0.1 * (bound - size.nominal)} | typical for bound in bounds]

    def delay(self, p: Values) -> Tensor:
        """COMMAND, READING: by how many seconds the signal is late (only where `delays`)."""
        raise NotImplementedError

    def remember(self, value: Tensor, p: Values) -> Memory:
        """COMMAND, READING: the memory of a signal that has long been `value`."""
        return ()

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        """COMMAND: the mean command (or valve opening) over the step -> what the actuator does, and its memory."""
        return value, memory

    def head(self, head: Tensor, local: Local, p: Values) -> Tensor:
        """FLOW: the head that drives a pipe, m."""
        return head

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        """FLOW: the flow of a pump, pipe or outlet, m^3/s, positive from source to target."""
        return flow

    def inflow(self, local: Local, p: Values) -> Tensor:
        """BALANCE: further net inflow of a tank, m^3/s; at a tank pair 'A-B' what flows from A to B."""
        raise NotImplementedError

    def caught(self, p: Values) -> Mapping[str, Tensor]:
        """BALANCE at a tank: which share of what it loses other tanks get; the rest leaves the plant."""
        return {}

    def area(self, area: Tensor, local: Local, p: Values) -> Tensor:
        """STORAGE: cross-section at the present level, m^2."""
        return area

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        """READING: value at the end of the sampling interval -> the sensor's value, and its memory."""
        return value, memory

    def resolution(self, p: Values) -> Tensor:
        """READING: the width of one step of a rounded reading (only where `rounds`), in the reading's unit."""
        raise NotImplementedError


@dataclass(frozen=True)
class Placement:
    """An effect at a place. values: what its parameters are believed to be (SI); nominal where not named."""

    effect: Effect
    location: str
    values: Mapping[str, float] | None = None

    @property
    def prefix(self) -> str:
        return f"{self.location}.{self.effect.name}"


def place_kind(plant: PlantDescription, location: str) -> str:
    """'pump', 'pipe', 'outlet', 'tank', 'tank_pair' or 'sensor'. Raises ValueError for a place the plant lacks."""
    if location in {f"{a}-{b}" for a, b in plant.tank_pairs()}:
        return "tank_pair"
    component = plant.component(location)
    if isinstance(component, Pipe):
        return "outlet" if component.is_outlet else "pipe"
    return {Tank: "tank", Pump: "pump", Sensor: "sensor"}[type(component)]


def fits(effect: Effect, plant: PlantDescription, location: str) -> bool:
    """Whether the effect can sit there."""
    kind = place_kind(plant, location)
    component = None if kind == "tank_pair" else plant.component(location)
    with_valve = isinstance(component, Pipe) and component.valve is not None
    return kind in effect.places or (with_valve and "valve" in effect.places)
