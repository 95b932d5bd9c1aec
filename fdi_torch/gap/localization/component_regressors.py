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
from fdi_torch.gap.localization.regressors import (
    LAGS,
    RAMPS,
    bends,
    jerks,
    jumps,
    lagged,
    memories,
    relays,
    slews,
    sticks,
    tirings,
)
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump
from fdi_torch.plant.effect import place_kind
from fdi_torch.plant.scales import time_scale

Signals = dict[str, Tensor]
RELAYS = 6  # values between which a place may switch
SLOW = (100.0, 300.0)  # s, of a chamber beside a tank


class SignalRanges:
    """The least and the greatest value of each signal in all recordings, and forms between them."""

    def __init__(self, seen: Sequence[Signals]) -> None:
        self.seen = seen

    def __call__(self, name: str) -> tuple[float, float]:
        low, high = min(float(s[name].min()) for s in self.seen), max(float(s[name].max()) for s in self.seen)
        return low, max(high, low + 1e-9 * (max(abs(low), abs(high)) or 1.0))

    def bends(self, s: Signals, name: str, count: int) -> list[Tensor]:
        return bends(s[name], self(name), 2 * count)

    def jumps(self, s: Signals, name: str, count: int) -> list[Tensor]:
        return jumps(s[name], self(name), 3 * count)

    def relays(self, s: Signals, name: str) -> list[tuple[float, Tensor]]:
        return relays(s[name], self(name), RELAYS)


RegressorFunction = Callable[[Signals, Tensor, SignalRanges], list[Tensor]]  # signals (K,), steps (K,) s -> (K,) each


@dataclass(frozen=True)
class DiscrepancyModel:
    """signals: what it knows along a recording. flows: forms in m^3/s, or to be scaled to it, from `source` to
    `target`; in_time: the signal that a course in time multiplies. areas: forms of a change of the target's level, m/s.
    """

    signals: Callable[[Forcing], Signals]
    flows: RegressorFunction
    in_time: str
    source: str
    target: str
    areas: RegressorFunction | None = None


def component_at(place: str, plant: PlantDescription) -> DiscrepancyModel:
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


def of_reading(s: Signals, step: Tensor, ends: SignalRanges, pace: float) -> list[Tensor]:
    """Forms of a sensor's discrepancy; step: between samples, s; pace: of the plant."""
    own = [*ends.bends(s, "reading", 12), s["reading"] * s["time"] / ends("time")[1]]
    lag = lagged(s["reading"], step, pace * LAGS[0]) - s["reading"]
    own += [lag * (s["time"] / ends("time")[1] - j / RAMPS).clamp(min=0.0) for j in range(RAMPS)]  # a clock that drifts
    return [*own, *memories(s["reading"], step, pace), *sticks(s["reading"], ends("reading"))]


def _pump(pump: Pump, plant: PlantDescription) -> DiscrepancyModel:
    which, tank, pace = plant.pumps.index(pump), _index(plant, pump.target), time_scale(plant)

    def signals(along: Forcing) -> Signals:
        return {"command": along.commands[which], "flow": along.pumps[which], "level": along.levels[tank]}

    def flows(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        own = [*ends.bends(s, "command", 9), *memories(s["flow"], step, pace)]
        own += [s["flow"] * b for b in ends.bends(s, "level", 6)]
        own += slews(s["flow"], step, ends("flow"), pace)
        own += jerks(s["flow"], ends("flow"))
        return [*own, *sticks(s["flow"], ends("flow")), *tirings(s["flow"], step, ends("flow"), pace)]

    return DiscrepancyModel(signals, flows, "flow", OUTSIDE, pump.target)


def _pipe(pipe: Pipe, plant: PlantDescription) -> DiscrepancyModel:
    which, pace = plant.pipes.index(pipe), time_scale(plant)
    valve = len(plant.pumps) + sum(1 for p in plant.pipes[:which] if p.valve)

    def signals(along: Forcing) -> Signals:
        head = along.levels[_index(plant, pipe.source)] - pipe.elevation
        if not pipe.is_outlet:
            far = along.levels[_index(plant, pipe.target)] - pipe.elevation
            head = head.clamp(min=0.0) - far.clamp(min=0.0) if pipe.elevation else head - far
        known = {"root": _root(head), "flow": along.pipes[which]}
        return known | ({"opening": along.commands[valve]} if pipe.valve else {})

    def flows(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        own = [*ends.bends(s, "root", 16), *memories(s["flow"], step, pace)]
        own += [s["flow"] * j for j in ends.jumps(s, "root", 24)]
        own += [s["flow"] * on for _, on in ends.relays(s, "root")]
        if pipe.valve:
            own += [s["root"] * b for b in ends.bends(s, "opening", 9)]
            own += memories(s["root"] * s["opening"], step, pace)
        return [*own, *sticks(s["flow"], ends("flow")), *tirings(s["flow"], step, ends("flow"), pace)]

    return DiscrepancyModel(signals, flows, "flow", pipe.source, pipe.target)


def _pair(place: str, plant: PlantDescription) -> DiscrepancyModel:
    first, second = place.split("-")

    def signals(along: Forcing) -> Signals:
        head = along.levels[_index(plant, first)] - along.levels[_index(plant, second)]
        return {"head": head, "root": _root(head)}

    def flows(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        return [*ends.bends(s, "head", 10), *ends.bends(s, "root", 10)]

    return DiscrepancyModel(signals, flows, "root", first, second)


def _tank(place: str, plant: PlantDescription) -> DiscrepancyModel:
    tank, pace = _index(plant, place), time_scale(plant)

    def signals(along: Forcing) -> Signals:
        level = along.levels[tank]
        return {"level": level, "rate": along.still[tank], "one": torch.ones_like(level)}

    def flows(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        own = [*ends.bends(s, "level", 12), *ends.jumps(s, "level", 24)]
        for low, on in ends.relays(s, "level"):  # a draw, an orifice at the floor, and one that low
            own += [on, on * _root(s["level"]), on * _root((s["level"] - low).clamp(min=0.0))]
        # No short lags: how the level lags behind itself is its own rate, which is all that there is to explain.
        own += [lagged(s["level"], step, pace * tau) - s["level"] for tau in SLOW]
        return [*own, *sticks(s["level"], ends("level"))]

    def areas(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        return [s["rate"] * b for b in ends.bends(s, "level", 12)]

    return DiscrepancyModel(signals, flows, "one", OUTSIDE, place, areas)


def _index(plant: PlantDescription, tank: str) -> int:
    return [t.name for t in plant.tanks].index(tank)


def _root(head: Tensor) -> Tensor:
    return torch.sign(head) * torch.sqrt(head.abs())
