"""The interface of an effect: a fault or an unmodelled effect of one component.

Both are a deviation of one component from the nominal model, with an equation and with parameters that vanish at their
nominal value. An effect overrides the hook of its stage; every other hook passes its value on unchanged.
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
from fdi_torch.plant.operating_range import OperatingRange
from fdi_torch.plant.orifice import signed_root
from fdi_torch.plant.signals import Clock

Memory = tuple[Tensor, ...]
Values = Mapping[str, Tensor]


class Stage(Enum):
    """The part of the model in which an effect acts, in the order in which `TankNetwork` computes them."""

    COMMAND = "command"
    FLOW = "flow"
    BALANCE = "balance"
    STORAGE = "storage"
    READING = "reading"


@dataclass(frozen=True)
class Local:
    """The conditions at one place at one instant. All (*batch), SI.

    level: of the tank (pump: its target; pipe: its source); far_level: at the other end; head: driving head of the
    flow; capacity: flow at 1 m of head through the place's orifice (tank: through its leak reference), m^2.5/s;
    command: of the pump, or opening of the valve; net: net inflow of the tank so far, m^3/s (BALANCE; elsewhere 0);
    width: head below which square roots are smoothed, m; height: of the tank, floor to rim, m; gravity: m/s^2;
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
        """Regularised signed square root of a head, sgn(x) sqrt(|x|), m^0.5 (see `signed_root`)."""
        return signed_root(head, self.width)

    def magnitude(self, head: Tensor) -> Tensor:
        """|head| smoothed at zero to sqrt(x^2 + w^2), so that it can be a divisor, m."""
        return torch.sqrt(head * head + self.width * self.width)


class Effect:
    """Base class of all faults and unmodelled effects.

    name: as in configurations and results. stage: the stage whose hook it overrides. places: the kinds of component at
    which it can be placed, of 'pump', 'pipe', 'outlet', 'valve', 'tank', 'tank_pair', 'sensor'. memory: number of its
    memory states. smooth: whether the gradient with respect to its size is non-zero at nominal. mistaken_for: effects
    that explain nearly the same data. delays: whether it adds dead time to its signal. quantizes: whether it rounds
    the reading. startup_only: whether it acts only until its component has run for the first time.

    The first parameter is the effect's size: at its nominal value the effect is absent. The others are its shape; their
    nominal values are typical ones, or those that keep the effect simple (onset 0, ramp 0).
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    places: ClassVar[tuple[str, ...]]
    memory: ClassVar[int] = 0
    smooth: ClassVar[bool] = True
    delays: ClassVar[bool] = False
    quantizes: ClassVar[bool] = False
    startup_only: ClassVar[bool] = False
    mistaken_for: ClassVar[tuple[str, ...]] = ()

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        """Its parameters at that place, size first, under their short names; ranges may depend on the component."""
        raise NotImplementedError

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        """Starting points for a fit (SI, short names). Only the named parameters are fitted; the others stay nominal.

        Default: 10 % of the size's range in each direction with the nominal shape. Effects with a threshold, where the
        gradient vanishes, return a coarse grid over the operating range.
        """
        size, *shape = self.parameters(place, plant)
        typical = {p.name: p.nominal for p in shape}
        bounds = [bound for bound in (size.low, size.high) if bound != size.nominal]
        return [{size.name: size.nominal + 0.1 * (bound - size.nominal)} | typical for bound in bounds]

    def delay(self, p: Values) -> Tensor:
        """COMMAND, READING: dead time that the effect adds to its signal, s (only where `delays`)."""
        raise NotImplementedError

    def steady_memory(self, value: Tensor, p: Values) -> Memory:
        """COMMAND, READING: the memory in steady state, after the signal has been `value` for a long time."""
        return ()

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        """COMMAND: mean command (or valve opening) over the step -> mean actuator output over the step, new memory."""
        return value, memory

    def head(self, head: Tensor, local: Local, p: Values) -> Tensor:
        """FLOW: the driving head of a pipe, m."""
        return head

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        """FLOW: the flow of a pump, pipe or outlet, m^3/s, positive from source to target."""
        return flow

    def inflow(self, local: Local, p: Values) -> Tensor:
        """BALANCE: additional net inflow of a tank, m^3/s; at a tank pair 'A-B', the flow from A to B."""
        raise NotImplementedError

    def recipients(self, p: Values) -> Mapping[str, Tensor]:
        """BALANCE at a tank: share of the lost flow that each other tank receives; the rest leaves the plant."""
        return {}

    def area(self, area: Tensor, local: Local, p: Values) -> Tensor:
        """STORAGE: cross-section at the present level, m^2."""
        return area

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        """READING: sensor signal at the end of the sampling interval -> indicated value, new memory."""
        return value, memory

    def resolution(self, p: Values) -> Tensor:
        """READING: quantization step in the reading's unit (only where `quantizes`)."""
        raise NotImplementedError


@dataclass(frozen=True)
class Placement:
    """An effect at a place. values: its known parameters (SI); the others are nominal."""

    effect: Effect
    location: str
    values: Mapping[str, float] | None = None

    @property
    def prefix(self) -> str:
        return f"{self.location}.{self.effect.name}"


def place_kind(plant: PlantDescription, location: str) -> str:
    """'pump', 'pipe', 'outlet', 'tank', 'tank_pair' or 'sensor'. Raises ValueError for an unknown place."""
    if location in {f"{a}-{b}" for a, b in plant.tank_pairs()}:
        return "tank_pair"
    component = plant.component(location)
    if isinstance(component, Pipe):
        return "outlet" if component.is_outlet else "pipe"
    return {Tank: "tank", Pump: "pump", Sensor: "sensor"}[type(component)]


def fits(effect: Effect, plant: PlantDescription, location: str) -> bool:
    """Whether the effect can be placed at this location."""
    kind = place_kind(plant, location)
    component = None if kind == "tank_pair" else plant.component(location)
    with_valve = isinstance(component, Pipe) and component.valve is not None
    return kind in effect.places or (with_valve and "valve" in effect.places)
