"""Local signals of each kind of component, and the regressors of its discrepancy.

A commanded flow depends on its command and its tank's level, any other flow on its head and its valve, a tank on its
level, a pair of tanks on their difference, a sensor on its reading. Flows and sensors may also depend on the past of
these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

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

Signals = dict[str, Tensor]
FineRegressor = Breakpoints | Relays | Curves | Pulses
FineRegressors = list[FineRegressor]
RELAYS = 6  # thresholds of relays
FINER = 8  # factor by which kinks, jumps, bands and travel times may lie more closely than in the first grid
FINER_RELAYS = 4  # the same for thresholds of relays, of which there are as many as pairs of these
SLOW = (100.0, 300.0)  # time constants (s) of a side chamber of a tank


@dataclass(frozen=True)
class Terms:
    """Regressors (K,) on a coarse grid, or several with coefficients of one variance (N, K); and families of the same
    ones on finer grids."""

    grid: Sequence[Tensor]
    fine: Sequence[FineRegressor] = ()


class LocalSignals:
    """Local signals (K,) along one recording, and the terms that depend on them.

    step (K,): lengths of the steps, s. scale: time scale of the plant. recordings: the signals of all recordings,
    between whose minimum and maximum the grids lie. In all terms, factor is the name of a signal that multiplies
    the regressors, if given.
    """

    def __init__(self, signals: Signals, step: Tensor, scale: float, recordings: Sequence[Signals]) -> None:
        self.signals, self.step, self.scale, self.recordings = signals, step, scale, recordings

    def ends(self, signal: str) -> tuple[float, float]:
        """Minimum and maximum of a signal over all recordings."""
        low = min(float(s[signal].min()) for s in self.recordings)
        high = max(float(s[signal].max()) for s in self.recordings)
        return low, max(high, low + 1e-9 * (max(abs(low), abs(high)) or 1.0))

    def smooth(self, signal: str, count: int, factor: str = "") -> Terms:
        """A piecewise linear function with 2 `count` nodes, and kinks between these, at FINER times as many places."""
        grid = smooth_function(self.signals[signal], self.ends(signal), 2 * count)
        return self._terms(factor, grid, self._breakpoints(signal, 2 * FINER * count, factor, jump=False))

    def jumps(self, signal: str, count: int, factor: str = "") -> Terms:
        """Steps at 3 `count` values, and jumps between these, at FINER times as many places."""
        grid = steps_in_value(self.signals[signal], self.ends(signal), 3 * count)
        return self._terms(factor, grid, self._breakpoints(signal, 3 * FINER * count + 2, factor, jump=True))

    def relays(self, signal: str, factor: str) -> Terms:
        """Relays of a signal."""
        return self._terms(factor, (on for _, on in self._switched(signal)), self._fine_relays(signal, factor))

    def switched_draws(self, level: str, root: str) -> Terms:
        """A constant draw, an orifice at the floor, and one at the lower threshold of a relay that switches it."""
        x, y = self.signals[level], self.signals[root]
        each = ((on, on * y, on * _root((x - low).clamp(min=0.0))) for low, on in self._switched(level))
        return Terms(list(chain(*each)), [self._fine_relays(level, ""), self._fine_relays(level, root)])

    def lags(self, signal: str) -> Terms:
        return Terms(lags_and_decays(self.signals[signal], self.step, self.scale))

    def slow_lags(self, signal: str) -> Terms:
        x = self.signals[signal]
        return Terms([lagged(x, self.step, self.scale * tau) - x for tau in SLOW])

    def play(self, signal: str, factor: str = "") -> Terms:
        x, ends, bands = self.signals[signal], self.ends(signal), finer(BACKLASH_BANDS, FINER)
        fine = self._times(factor, backlashes(x, ends, bands, BACKLASH_STARTS))
        return self._terms(factor, backlashes(x, ends), Curves(torch.stack(fine)))

    def actuator(self, signal: str, factor: str = "") -> list[Terms]:
        """What an actuator adds to its flow or opening if it lags, sticks, or has a limited rate or play."""
        x, ends, lags = self.signals[signal], self.ends(signal), self.lags(signal).grid
        coarse = [*lags, *rate_limits(x, self.step, ends, self.scale), *stictions(x, ends)]
        slow = rate_limits(x, self.step, ends, self.scale, finer(TRAVEL_TIMES, FINER))
        curves = [torch.stack(self._times(factor, f)) for f in (slow, stictions(x, ends, FINE_STICTION_BANDS))]
        return [self._terms(factor, coarse, *map(Curves, curves)), self.play(signal, factor)]

    def fatigue(self, signal: str) -> Terms:
        return Terms(fatigues(self.signals[signal], self.step, self.ends(signal), self.scale))

    def clock_drift(self, signal: str) -> Terms:
        """A gain that grows with time, and delays that grow from some time on."""
        x, time, end = self.signals[signal], self.signals["time"], self.ends("time")[1]
        lag = lagged(x, self.step, self.scale * LAGS[0]) - x
        return Terms([x * time / end, *(lag * (time / end - j / RAMPS).clamp(min=0.0) for j in range(RAMPS))])

    def _terms(self, factor: str, grid: Iterable[Tensor], *fine: FineRegressor) -> Terms:
        return Terms(self._times(factor, grid), fine)

    def _times(self, factor: str, functions: Iterable[Tensor]) -> list[Tensor]:
        return [self.signals[factor] * f for f in functions] if factor else list(functions)

    def _factor(self, factor: str, signal: str) -> Tensor:
        return self.signals[factor] if factor else torch.ones_like(self.signals[signal])

    def _breakpoints(self, signal: str, count: int, factor: str, jump: bool) -> Breakpoints:
        x = self.signals[signal]
        at = torch.linspace(*self.ends(signal), count, dtype=x.dtype)[1:-1]
        return Breakpoints(x, self._factor(factor, signal), at, jump)

    def _switched(self, signal: str) -> list[tuple[float, Tensor]]:
        """The lower threshold and the output of each relay."""
        x, thresholds = self.signals[signal], relay_thresholds(self.ends(signal), RELAYS)
        return list(zip(thresholds[:, 0].tolist(), relay(x, thresholds).to(x.dtype), strict=True))

    def _fine_relays(self, signal: str, factor: str) -> Relays:
        thresholds = relay_thresholds(self.ends(signal), FINER_RELAYS * RELAYS)
        return Relays(self.signals[signal], self._factor(factor, signal), thresholds)


@dataclass(frozen=True)
class DiscrepancyModel:
    """Discrepancy of one component: a flow from `source` to `target`.

    signals: the local signals along a recording. terms: in m^3/s, or to be scaled to it. in_time: name of the signal
    that functions of time multiply. areas: of a relative change of the target's area, as level rates in m/s.
    """

    signals: Callable[[Forcing], Signals]
    terms: Callable[[LocalSignals], list[Terms]]
    in_time: str
    source: str
    target: str
    areas: Callable[[LocalSignals], Terms] | None = None


def discrepancy_model_at(place: str, plant: PlantDescription) -> DiscrepancyModel:
    """The discrepancy model of a place other than a sensor."""
    kind = place_kind(plant, place)
    if kind == "tank_pair":
        return _pair(place, plant)
    if kind == "tank":
        return _tank(place, plant)
    component = plant.component(place)
    assert isinstance(component, FlowComponent)
    return _commanded(component, plant) if component.commanded else _by_head(component, plant)


def reading_terms(at: LocalSignals) -> list[Terms]:
    """The discrepancy of a sensor, in its unit; at: its samples."""
    return [at.smooth("reading", 12), at.clock_drift("reading"), at.lags("reading"), at.play("reading")]


def _commanded(component: FlowComponent, plant: PlantDescription) -> DiscrepancyModel:
    name, tank, actuator = component.name, _index(plant, component.near_tank), _actuator(plant, component.name)

    def signals(trajectory: Forcing) -> Signals:
        command = trajectory.commands[actuator]
        return {
            "command": command,
            "below": -command,  # its steps are the flow below a command, where a pump may stall
            "flow": trajectory.flows[name],
            "level": trajectory.levels[tank],
        }

    def terms(at: LocalSignals) -> list[Terms]:
        below, level = at.jumps("below", 9, "flow"), at.smooth("level", 6, "flow")
        return [at.smooth("command", 9), *at.actuator("flow"), below, level, at.fatigue("flow")]

    return DiscrepancyModel(signals, terms, "flow", component.source, component.target)


def _by_head(component: FlowComponent, plant: PlantDescription) -> DiscrepancyModel:
    name, has_valve = component.name, component.input_channel is not None

    def signals(trajectory: Forcing) -> Signals:
        head = trajectory.heads[name]
        here = {"head": head, "root": _root(head), "flow": trajectory.flows[name]}
        return here | ({"opening": trajectory.commands[_actuator(plant, name)]} if has_valve else {})

    def terms(at: LocalSignals) -> list[Terms]:
        law = [at.smooth("root", 16), at.smooth("head", 12), at.lags("flow"), at.jumps("root", 24, "flow")]
        valve = [at.smooth("opening", 9, "root"), *at.actuator("opening", "root")] if has_valve else []
        return [*law, at.relays("root", "flow"), *valve, at.play("flow"), at.fatigue("flow")]

    return DiscrepancyModel(signals, terms, "flow", component.source, component.target)


def _actuator(plant: PlantDescription, name: str) -> int:
    """Index of a component among those with an input channel."""
    return [c.name for c in plant.flows_in_order if c.input_channel is not None].index(name)


def _pair(place: str, plant: PlantDescription) -> DiscrepancyModel:
    first, second = plant.tanks_at(place)

    def signals(trajectory: Forcing) -> Signals:
        head = trajectory.levels[_index(plant, first)] - trajectory.levels[_index(plant, second)]
        return {"head": head, "root": _root(head)}

    def terms(at: LocalSignals) -> list[Terms]:
        return [at.smooth("head", 10), at.smooth("root", 10)]

    return DiscrepancyModel(signals, terms, "root", first, second)


def _tank(place: str, plant: PlantDescription) -> DiscrepancyModel:
    tank = _index(plant, place)

    def signals(trajectory: Forcing) -> Signals:
        level, rate = trajectory.levels[tank], trajectory.unforced[tank]
        return {"level": level, "root": _root(level), "rate": rate, "one": torch.ones_like(level)}

    def terms(at: LocalSignals) -> list[Terms]:
        law = [at.smooth("level", 12), at.jumps("level", 24), at.switched_draws("level", "root")]
        # No short lags: a short lag of the level is its rate, which the balance explains already.
        return [*law, at.slow_lags("level"), at.play("level")]

    return DiscrepancyModel(signals, terms, "one", OUTSIDE, place, lambda at: at.smooth("level", 12, "rate"))


def _index(plant: PlantDescription, tank: str) -> int:
    return [t.name for t in plant.tanks].index(tank)


def _root(head: Tensor) -> Tensor:
    return torch.sign(head) * torch.sqrt(head.abs())
