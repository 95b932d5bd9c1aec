"""The interface of an effect: a fault or an unmodelled effect of one component.

Both are a deviation of one component from the nominal model, with an equation and with parameters that vanish at their
nominal value. An effect overrides the hook of its stage; every other hook passes its value on unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import ClassVar

import torch

from fdi_torch.parameters import Parameter, ParameterName
from fdi_torch.plant.description import FLOW_KINDS, PlantDescription
from fdi_torch.plant.flow_component import FlowComponent, FlowOrder
from fdi_torch.plant.local_conditions import Local, Values
from fdi_torch.plant.operating_range import OperatingRange
from fdi_torch.plant.signals import Clock

__all__ = [
    *("Effect", "Memory", "Placement", "Stage"),
    *("expect_fit", "fits", "place_kind", "place_kinds_of", "placed_parameters"),
    # for the files of effects
    *("Clock", "Equivalents", "Local", "OperatingRange", "Parameter", "PlantDescription", "Values"),
]

Memory = tuple["torch.Tensor", ...]
Equivalents = Mapping[tuple[str, str], Mapping[str, float]]
"""Parameters (SI, short names) by effect and place."""


class Stage(Enum):
    """The part of the model in which an effect acts, in the order in which `TankNetwork` computes them."""

    COMMAND = "command"
    FLOW = "flow"
    BALANCE = "balance"
    STORAGE = "storage"
    READING = "reading"


class Effect:
    """Base class of all faults and unmodelled effects.

    name: as in configurations and results. stage: the stage whose hook it overrides. places: the kinds of component at
    which it can be placed, of 'pump', 'pipe', 'outlet', 'valve', 'tank', 'tank_pair', 'sensor'; a flow component can
    accept further effects (`FlowComponent.accepts`). memory: number of its memory states, for a COMMAND or READING
    effect whose output depends on the past of its signal alone. states: number of its integrated states, for a FLOW
    or BALANCE effect coupled to the levels; each is in m and of the order of a level, since one tolerance holds for
    all. smooth: whether the gradient with respect to its size is non-zero at nominal. mistaken_for: effects that
    explain nearly the same data. delays: whether it adds dead time to its signal. quantizes: whether it rounds the
    reading. startup_only: whether it acts only until its component has run for the first time. capacity_share: whether
    its size is a share of the capacity of its tank's reference pipe. instants: its parameters that are times, of which
    its starts form a grid: an onset, or the begin and the duration of an interval. searched: whether a gap diagnosis
    searches it by default.

    The first parameter is the effect's size: at its nominal value the effect is absent. The others are its shape; their
    nominal values are typical ones, or those that keep the effect simple (onset 0, ramp 0).
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    places: ClassVar[tuple[str, ...]]
    memory: ClassVar[int] = 0
    states: ClassVar[int] = 0
    smooth: ClassVar[bool] = True
    delays: ClassVar[bool] = False
    quantizes: ClassVar[bool] = False
    startup_only: ClassVar[bool] = False
    capacity_share: ClassVar[bool] = False
    instants: ClassVar[tuple[str, ...]] = ()
    searched: ClassVar[bool] = True
    mistaken_for: ClassVar[tuple[str, ...]] = ()

    @property
    def quantity(self) -> str:
        """What it changes: 'area', the cross-section of a tank, or else 'flow', which stands for a reading too."""
        return "area" if self.stage is Stage.STORAGE else "flow"

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

    def equivalents(self, place: str, plant: PlantDescription, values: Mapping[str, float]) -> Equivalents:
        """Other effects with the same equations: name and place, and the parameters with which they are the same.

        values: its own parameters (SI, short names); a parameter without a value may have any. An effect that is the
        same through another need not be named. Each of the others names this one in turn.
        """
        return {}

    def delay(self, p: Values) -> torch.Tensor:
        """COMMAND, READING: dead time that the effect adds to its signal, s (only where `delays`)."""
        raise NotImplementedError

    def steady_memory(self, value: torch.Tensor, p: Values) -> Memory:
        """COMMAND, READING: the memory in steady state, after the signal has been `value` for a long time."""
        return ()

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        """COMMAND: mean command (or valve opening) over the step -> mean actuator output over the step, new memory."""
        return value, memory

    def head(self, head: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        """FLOW: the driving head of a pipe, m."""
        return head

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        """FLOW: the flow of a pump, pipe or outlet, m^3/s, positive from source to target."""
        return flow

    def steady_states(self, flow: torch.Tensor, local: Local, p: Values) -> tuple[torch.Tensor, ...]:
        """FLOW, BALANCE: its states in steady state, m, where the flow before the effect has been `flow` (m^3/s) for a
        long time; at BALANCE it is 0.
        """
        return ()

    def state_rates(self, flow: torch.Tensor, local: Local, p: Values) -> tuple[torch.Tensor, ...]:
        """FLOW, BALANCE: rate of change of each of its states `local.states`, m/s; flow (m^3/s) is the one before the
        effect, 0 at BALANCE.
        """
        return ()

    def inflow(self, local: Local, p: Values) -> torch.Tensor:
        """BALANCE: additional net inflow of a tank, m^3/s; at a tank pair 'A-B', the flow from A to B."""
        raise NotImplementedError

    def recipients(self, p: Values) -> Mapping[str, torch.Tensor]:
        """BALANCE at a tank: share of the lost flow that each other tank receives; the rest leaves the plant."""
        return {}

    def area(self, area: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        """STORAGE: cross-section at the present level, m^2."""
        return area

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        """READING: sensor signal at the end of the sampling interval -> indicated value, new memory."""
        return value, memory

    def resolution(self, p: Values) -> torch.Tensor:
        """READING: quantization step in the reading's unit (only where `quantizes`)."""
        raise NotImplementedError


@dataclass(frozen=True)
class Placement:
    """An effect at a place. values: its known parameters (SI); the others are nominal."""

    effect: Effect
    location: str
    values: Mapping[str, float] | None = None

    @cached_property
    def prefix(self) -> str:
        return f"{self.location}.{self.effect.name}"

    @property
    def cause(self) -> tuple[str, str]:
        """Name of the effect, and place."""
        return self.effect.name, self.location

    def full_name(self, parameter: str) -> str:
        """'T1.leak.size' for the parameter 'size' of a leak at T1."""
        return str(ParameterName(self.location, self.effect.name, parameter))


def place_kind(plant: PlantDescription, location: str) -> str:
    """'tank', 'sensor', 'tank_pair' or one of a flow kind's `place_kinds`. Raises ValueError for an unknown place."""
    if len(plant.tanks_at(location)) == 2:
        return "tank_pair"
    return plant.component(location).place_kind


def fits(effect: Effect, plant: PlantDescription, location: str) -> bool:
    """Whether the effect can be placed at this location."""
    kind = place_kind(plant, location)
    component = None if kind == "tank_pair" else plant.component(location)
    if kind in effect.places or not isinstance(component, FlowComponent):
        return kind in effect.places
    with_valve = component.input_channel is not None and not component.commanded
    return effect.name in component.accepts or (with_valve and "valve" in effect.places)


def place_kinds_of(effect: Effect) -> tuple[str, ...]:
    """The kinds of place at which the effect can be placed, with those of the flow components that accept it."""
    accepting = (name for kind in FLOW_KINDS if effect.name in kind.accepts for name in kind.place_kinds)
    return tuple(dict.fromkeys((*effect.places, *accepting)))


def placed_parameters(placement: Placement, plant: PlantDescription) -> list[Parameter]:
    """The effect's parameters under their full names ('T1.leak.size'), nominal at the placement's known values."""
    known = dict(placement.values or {})
    parameters = []
    for p in placement.effect.parameters(placement.location, plant):
        nominal = known.pop(p.name, p.nominal)
        low, high = min(p.low, nominal), max(p.high, nominal)
        name = placement.full_name(p.name)
        std = plant.tolerances.get(name, p.std)
        parameters.append(replace(p, name=name, nominal=nominal, low=low, high=high, std=std))
    if known:
        expected = ", ".join(p.name for p in placement.effect.parameters(placement.location, plant))
        raise ValueError(f"{placement.prefix}: expected parameters of {expected}, got {', '.join(known)}")
    return parameters


def expect_fit(plant: PlantDescription, placement: Placement) -> None:
    """Raises ValueError for a placement where its effect cannot be."""
    if not fits(placement.effect, plant, placement.location):
        kinds = " or ".join(place_kinds_of(placement.effect))
        raise ValueError(f"{placement.prefix}: expected a place of kind {kinds}, got {placement.location}")
    stage = placement.effect.stage
    if not placement.effect.states or stage is Stage.BALANCE:
        return
    component = plant.component(placement.location)
    by_levels = isinstance(component, FlowComponent) and component.order <= FlowOrder.BY_LEVELS
    if stage is not Stage.FLOW or not by_levels:
        raise ValueError(
            f"{placement.prefix}: expected states only in a BALANCE effect, or in a FLOW effect of a component whose "
            f"flow depends on levels and commands alone, got {stage.name} at {placement.location}"
        )
