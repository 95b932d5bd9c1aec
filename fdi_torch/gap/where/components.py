"""What each kind of component knows of where it sits, and of which forms its discrepancy may be.

A pump knows its command and its tank's level, a pipe its head and its valve, a tank its level, a pair of tanks their
difference, a sensor its reading; pumps, pipes and sensors also what these have been.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.forcing import Forcing
from fdi_torch.gap.where.forms import bends, jumps, memories, slews, sticks, tirings
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump
from fdi_torch.plant.effect import place_kind
from fdi_torch.plant.pace import time_scale

Signals = dict[str, Tensor]


class Ends:
    """The least and the greatest value of each signal in all recordings."""

    def __init__(self, seen: Sequence[Signals]) -> None:
        self.seen = seen

    def __call__(self, name: str) -> tuple[float, float]:
        low = min(float(s[name].min()) for s in self.seen)
        return low, max(*(float(s[name].max()) for s in self.seen), low + 1e-9)


Forms = Callable[[Signals, Tensor, Ends], list[Tensor]]  # signals (K,), steps (K,) s -> (K,) each


@dataclass(frozen=True)
class Component:
    """signals: what it knows along a recording. flows: forms in m^3/s, or to be scaled to it, from `source` to
    `target`; in_time: the signal that a course in time multiplies. areas: forms of a change of the target's level, m/s.
    """

    signals: Callable[[Forcing], Signals]
    flows: Forms
    in_time: str
    source: str
    target: str
    areas: Forms | None = None


def component_at(place: str, plant: PlantDescription) -> Component:
    """Of everything but sensors."""
    kind = place_kind(plant, place)
    if kind == "tank_pair":
        return _pair(place, plant)
    if kind == "tank":
        return _tank(place, plant)
    found = plant.component(place)
    if isinstance(found, Pump):
        return _pump(found, plant)
    assert isinstance(found, Pipe)
    return _pipe(found, plant)


def of_reading(s: Signals, step: Tensor, ends: Ends, pace: float) -> list[Tensor]:
    """Forms of a sensor's discrepancy; step: between samples, s; pace: of the plant."""
    own = [*bends(s["reading"], ends("reading"), 12), s["reading"] * s["time"] / ends("time")[1]]
    return [*own, *memories(s["reading"], step, pace), *sticks(s["reading"], ends("reading"))]


def _pump(pump: Pump, plant: PlantDescription) -> Component:
    which, tank, pace = plant.pumps.index(pump), _index(plant, pump.target), time_scale(plant)

    def signals(along: Forcing) -> Signals:
        return {"command": along.commands[which], "flow": along.pumps[which], "level": along.levels[tank]}

    def flows(s: Signals, step: Tensor, ends: Ends) -> list[Tensor]:
        own = [*bends(s["command"], ends("command"), 9), *memories(s["flow"], step, pace)]
        own += [s["flow"] * b for b in bends(s["level"], ends("level"), 6)]
        own += slews(s["flow"], step, ends("flow"), pace)
        return [*own, *sticks(s["flow"], ends("flow")), *tirings(s["flow"], step, ends("flow"), pace)]

    return Component(signals, flows, "flow", OUTSIDE, pump.target)


def _pipe(pipe: Pipe, plant: PlantDescription) -> Component:
    which, pace = plant.pipes.index(pipe), time_scale(plant)
    valve = len(plant.pumps) + sum(1 for p in plant.pipes[:which] if p.valve)

    def signals(along: Forcing) -> Signals:
        head = along.levels[_index(plant, pipe.source)] - pipe.elevation
        if not pipe.is_outlet:
            far = along.levels[_index(plant, pipe.target)] - pipe.elevation
            head = head.clamp(min=0.0) - far.clamp(min=0.0) if pipe.elevation else head - far
        known = {"root": _root(head), "flow": along.pipes[which]}
        return known | ({"opening": along.commands[valve]} if pipe.valve else {})

    def flows(s: Signals, step: Tensor, ends: Ends) -> list[Tensor]:
        own = [*bends(s["root"], ends("root"), 16), *memories(s["flow"], step, pace)]
        own += [s["flow"] * j for j in jumps(s["root"], ends("root"), 24)]
        if pipe.valve:
            own += [s["root"] * b for b in bends(s["opening"], ends("opening"), 9)]
            own += memories(s["root"] * s["opening"], step, pace)
        return [*own, *sticks(s["flow"], ends("flow")), *tirings(s["flow"], step, ends("flow"), pace)]

    return Component(signals, flows, "flow", pipe.source, pipe.target)


def _pair(place: str, plant: PlantDescription) -> Component:
    first, second = place.split("-")

    def signals(along: Forcing) -> Signals:
        head = along.levels[_index(plant, first)] - along.levels[_index(plant, second)]
        return {"head": head, "root": _root(head)}

    def flows(s: Signals, step: Tensor, ends: Ends) -> list[Tensor]:
        return [*bends(s["head"], ends("head"), 10), *bends(s["root"], ends("root"), 10)]

    return Component(signals, flows, "root", first, second)


def _tank(place: str, plant: PlantDescription) -> Component:
    tank = _index(plant, place)

    def signals(along: Forcing) -> Signals:
        level = along.levels[tank]
        return {"level": level, "rate": along.still[tank], "one": torch.ones_like(level)}

    def flows(s: Signals, step: Tensor, ends: Ends) -> list[Tensor]:
        own = [*bends(s["level"], ends("level"), 12), *jumps(s["level"], ends("level"), 24)]
        # No lags: how the level lags behind itself is its own rate, which is all that there is to explain.
        return [*own, *sticks(s["level"], ends("level"))]

    def areas(s: Signals, step: Tensor, ends: Ends) -> list[Tensor]:
        return [s["rate"] * b for b in bends(s["level"], ends("level"), 12)]

    return Component(signals, flows, "one", OUTSIDE, place, areas)


def _index(plant: PlantDescription, tank: str) -> int:
    return [t.name for t in plant.tanks].index(tank)


def _root(head: Tensor) -> Tensor:
    return torch.sign(head) * torch.sqrt(head.abs())
