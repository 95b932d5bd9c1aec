"""Local signals of each kind of component, and the regressors of its discrepancy.

A commanded flow depends on its command and its tank's level, any other flow on its head and its valve, a tank on its
level, a pair of tanks on their difference, a sensor on its reading. Flows and sensors may also depend on the past of
these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.gap.forcing import Forcing
from fdi_torch.gap.localization.regressor_families import Breakpoints, Curves, Pulses, Relays
from fdi_torch.gap.localization.regressors import (
    BACKLASH_BANDS,
    BACKLASH_STARTS,
    FINE_STICTION_BANDS,
    LAGS,
    RAMPS,
    TRAVEL_TIMES,
    backlashes,
    fatigues,
    finer,
    lagged,
    lags_and_decays,
    rate_limits,
    relay,
    relay_thresholds,
    smooth_function,
    steps_in_value,
    stictions,
)
from fdi_torch.plant.description import OUTSIDE, PlantDescription
from fdi_torch.plant.effect import place_kind
from fdi_torch.plant.flow_component import FlowComponent
from fdi_torch.plant.scales import time_scale

Signals = dict[str, Tensor]
RELAYS = 6  # thresholds of relays
FINER = 8  # factor by which kinks, jumps, bands and travel times may lie more closely than in the first grid
FINER_RELAYS = 4  # the same for thresholds of relays, of which there are as many as pairs of these
SLOW = (100.0, 300.0)  # time constants (s) of a side chamber of a tank


class SignalRanges:
    """Least and greatest value of each signal over all recordings, and regressors between them."""

    def __init__(self, recordings: Sequence[Signals]) -> None:
        self.recordings = recordings

    def __call__(self, name: str) -> tuple[float, float]:
        low, high = (
            min(float(s[name].min()) for s in self.recordings),
            max(float(s[name].max()) for s in self.recordings),
        )
        return low, max(high, low + 1e-9 * (max(abs(low), abs(high)) or 1.0))

    def smooth_function(self, s: Signals, name: str, count: int) -> list[Tensor]:
        return smooth_function(s[name], self(name), 2 * count)

    def steps_in_value(self, s: Signals, name: str, count: int) -> list[Tensor]:
        return steps_in_value(s[name], self(name), 3 * count)

    def kinks(self, s: Signals, name: str, count: int, factor: Tensor | None = None) -> Breakpoints:
        """Kinks on a grid that is FINER times as fine as that of `smooth_function` with this `count`."""
        return self._breakpoints(s, name, 2 * FINER * count, factor, jump=False)

    def jumps(self, s: Signals, name: str, count: int, factor: Tensor | None = None) -> Breakpoints:
        return self._breakpoints(s, name, 3 * FINER * count + 2, factor, jump=True)

    def _breakpoints(self, s: Signals, name: str, count: int, factor: Tensor | None, jump: bool) -> Breakpoints:
        at = torch.linspace(*self(name), count, dtype=s[name].dtype)[1:-1]
        return Breakpoints(s[name], torch.ones_like(s[name]) if factor is None else factor, at, jump)

    def relays(self, s: Signals, name: str) -> list[tuple[float, Tensor]]:
        """The lower threshold and the output of each relay."""
        thresholds = relay_thresholds(self(name), RELAYS)
        on = relay(s[name], thresholds).to(s[name].dtype)
        return list(zip(thresholds[:, 0].tolist(), on, strict=True))

    def fine_relays(self, s: Signals, name: str, factor: Tensor | None = None) -> Relays:
        """Relays with thresholds as closely spaced as those of `relays`, over FINER_RELAYS."""
        one = torch.ones_like(s[name]) if factor is None else factor
        return Relays(s[name], one, relay_thresholds(self(name), FINER_RELAYS * RELAYS))

    def fine_backlashes(self, s: Signals, name: str) -> Curves:
        bands = finer(BACKLASH_BANDS, FINER)
        return Curves(torch.stack(backlashes(s[name], self(name), bands, BACKLASH_STARTS)))


# Local signals (K,), step lengths (K,) s -> regressors (K,), or of several coefficients with one variance (N, K)
RegressorFunction = Callable[[Signals, Tensor, SignalRanges], list[Tensor]]
FineRegressor = Breakpoints | Relays | Curves | Pulses
FineRegressors = list[FineRegressor]
FineFunction = Callable[[Signals, Tensor, SignalRanges], FineRegressors]


@dataclass(frozen=True)
class DiscrepancyModel:
    """Regressors of one component's discrepancy.

    signals: the local signals along a recording. flows: regressors in m^3/s, or to be scaled to it, of a flow from
    `source` to `target`. fine: kinks, jumps and relays as among them on a finer grid. in_time: name of the signal that
    functions of time multiply. areas: regressors of a relative change of the target's area, as level rates in m/s.
    """

    signals: Callable[[Forcing], Signals]
    flows: RegressorFunction
    fine: FineFunction
    in_time: str
    source: str
    target: str
    areas: RegressorFunction | None = None


def discrepancy_model_at(place: str, plant: PlantDescription) -> DiscrepancyModel:
    """The discrepancy model of a place that is no sensor."""
    kind = place_kind(plant, place)
    if kind == "tank_pair":
        return _pair(place, plant)
    if kind == "tank":
        return _tank(place, plant)
    component = plant.component(place)
    assert isinstance(component, FlowComponent)
    return _commanded(component, plant) if component.commanded else _by_head(component, plant)


def reading_regressors(s: Signals, step: Tensor, ends: SignalRanges, scale: float) -> list[Tensor]:
    """Regressors of a sensor's discrepancy. step: sampling intervals, s. scale: time scale of the plant."""
    regressors = [*ends.smooth_function(s, "reading", 12), s["reading"] * s["time"] / ends("time")[1]]
    lag = lagged(s["reading"], step, scale * LAGS[0]) - s["reading"]
    regressors += [lag * (s["time"] / ends("time")[1] - j / RAMPS).clamp(min=0.0) for j in range(RAMPS)]  # clock drift
    return [*regressors, *lags_and_decays(s["reading"], step, scale), *backlashes(s["reading"], ends("reading"))]


def fine_reading_regressors(s: Signals, ends: SignalRanges) -> FineRegressors:
    """The kinks and the backlashes among `reading_regressors` on finer grids."""
    return [ends.kinks(s, "reading", 12), ends.fine_backlashes(s, "reading")]


def _commanded(component: FlowComponent, plant: PlantDescription) -> DiscrepancyModel:
    name, tank, scale = component.name, _index(plant, component.near_tank), time_scale(plant)
    actuator = _actuator(plant, name)

    def signals(trajectory: Forcing) -> Signals:
        command = trajectory.commands[actuator]
        return {
            "command": command,
            "below": -command,  # its steps are the flow below a command, where a pump may stall
            "flow": trajectory.flows[name],
            "level": trajectory.levels[tank],
        }

    def flows(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        regressors = [*ends.smooth_function(s, "command", 9), *_of_actuator(s["flow"], step, ends("flow"), scale)]
        regressors += [s["flow"] * j for j in ends.steps_in_value(s, "below", 9)]
        regressors += [s["flow"] * b for b in ends.smooth_function(s, "level", 6)]
        return [*regressors, *fatigues(s["flow"], step, ends("flow"), scale)]

    def fine(s: Signals, step: Tensor, ends: SignalRanges) -> FineRegressors:
        kinks = [ends.kinks(s, "command", 9), ends.kinks(s, "level", 6, s["flow"])]
        jumps = ends.jumps(s, "below", 9, s["flow"])
        return [*kinks, jumps, *_fine_of_actuator(s, "flow", step, ends, scale)]

    return DiscrepancyModel(signals, flows, fine, "flow", component.source, component.target)


def _of_actuator(x: Tensor, step: Tensor, ends: tuple[float, float], scale: float) -> list[Tensor]:
    """What an actuator adds to x, its flow or opening, if it lags, sticks, or has a limited rate or play."""
    return [
        *lags_and_decays(x, step, scale),
        *rate_limits(x, step, ends, scale),
        *stictions(x, ends),
        *backlashes(x, ends),
    ]


def _fine_of_actuator(s: Signals, name: str, step: Tensor, ends: SignalRanges, scale: float) -> list[Curves]:
    """The rate limits, stictions and plays among `_of_actuator` on finer grids. name: of the flow or the opening."""
    slow = rate_limits(s[name], step, ends(name), scale, finer(TRAVEL_TIMES, FINER))
    sticking = stictions(s[name], ends(name), FINE_STICTION_BANDS)
    return [Curves(torch.stack(slow)), Curves(torch.stack(sticking)), ends.fine_backlashes(s, name)]


def _by_head(component: FlowComponent, plant: PlantDescription) -> DiscrepancyModel:
    name, scale = component.name, time_scale(plant)
    has_valve = component.input_channel is not None

    def signals(trajectory: Forcing) -> Signals:
        head = trajectory.heads[name]
        here = {"head": head, "root": _root(head), "flow": trajectory.flows[name]}
        return here | ({"opening": trajectory.commands[_actuator(plant, name)]} if has_valve else {})

    def flows(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        regressors = [*ends.smooth_function(s, "root", 16), *ends.smooth_function(s, "head", 12)]
        regressors += lags_and_decays(s["flow"], step, scale)
        regressors += [s["flow"] * j for j in ends.steps_in_value(s, "root", 24)]
        regressors += [s["flow"] * on for _, on in ends.relays(s, "root")]
        if has_valve:
            of_valve = _of_actuator(s["opening"], step, ends("opening"), scale)
            regressors += [s["root"] * r for r in (*ends.smooth_function(s, "opening", 9), *of_valve)]
        return [*regressors, *backlashes(s["flow"], ends("flow")), *fatigues(s["flow"], step, ends("flow"), scale)]

    def fine(s: Signals, step: Tensor, ends: SignalRanges) -> FineRegressors:
        of_valve: FineRegressors = []
        if has_valve:
            past = _fine_of_actuator(s, "opening", step, ends, scale)
            of_valve = [ends.kinks(s, "opening", 9, s["root"]), *(Curves(s["root"] * c.values) for c in past)]
        jumps, relays = ends.jumps(s, "root", 24, s["flow"]), ends.fine_relays(s, "root", s["flow"])
        kinks = [ends.kinks(s, "root", 16), ends.kinks(s, "head", 12)]
        return [*kinks, jumps, relays, ends.fine_backlashes(s, "flow"), *of_valve]

    return DiscrepancyModel(signals, flows, fine, "flow", component.source, component.target)


def _actuator(plant: PlantDescription, name: str) -> int:
    """Index of a component among those with an input channel."""
    return [c.name for c in plant.flows_in_order() if c.input_channel is not None].index(name)


def _pair(place: str, plant: PlantDescription) -> DiscrepancyModel:
    first, second = plant.tanks_at(place)

    def signals(trajectory: Forcing) -> Signals:
        head = trajectory.levels[_index(plant, first)] - trajectory.levels[_index(plant, second)]
        return {"head": head, "root": _root(head)}

    def flows(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        return [*ends.smooth_function(s, "head", 10), *ends.smooth_function(s, "root", 10)]

    def fine(s: Signals, step: Tensor, ends: SignalRanges) -> FineRegressors:
        return [ends.kinks(s, "head", 10), ends.kinks(s, "root", 10)]

    return DiscrepancyModel(signals, flows, fine, "root", first, second)


def _tank(place: str, plant: PlantDescription) -> DiscrepancyModel:
    tank, scale = _index(plant, place), time_scale(plant)

    def signals(trajectory: Forcing) -> Signals:
        level = trajectory.levels[tank]
        return {"level": level, "rate": trajectory.still[tank], "one": torch.ones_like(level)}

    def flows(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        regressors = [*ends.smooth_function(s, "level", 12), *ends.steps_in_value(s, "level", 24)]
        for low, on in ends.relays(s, "level"):  # a constant draw, an orifice at the floor, and one at that height
            regressors += [on, on * _root(s["level"]), on * _root((s["level"] - low).clamp(min=0.0))]
        # No short lags: a short lag of the level is its rate, which the balance explains already.
        regressors += [lagged(s["level"], step, scale * tau) - s["level"] for tau in SLOW]
        return [*regressors, *backlashes(s["level"], ends("level"))]

    def areas(s: Signals, step: Tensor, ends: SignalRanges) -> list[Tensor]:
        return [s["rate"] * b for b in ends.smooth_function(s, "level", 12)]

    def fine(s: Signals, step: Tensor, ends: SignalRanges) -> FineRegressors:
        relays = [ends.fine_relays(s, "level"), ends.fine_relays(s, "level", _root(s["level"]))]
        return [ends.kinks(s, "level", 12), ends.jumps(s, "level", 24), *relays, ends.fine_backlashes(s, "level")]

    return DiscrepancyModel(signals, flows, fine, "one", OUTSIDE, place, areas)


def _index(plant: PlantDescription, tank: str) -> int:
    return [t.name for t in plant.tanks].index(tank)


def _root(head: Tensor) -> Tensor:
    return torch.sign(head) * torch.sqrt(head.abs())
