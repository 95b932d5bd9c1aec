"""Laws outside the library: how each is drawn, where it can be, and names under which a library might know it."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from fdi_torch.blind.deviation import Deviation
from fdi_torch.blind.nominal_run import NominalRun
from fdi_torch.blind.places import OUTLET, PIPE, PUMP, SENSOR, TANK


@dataclass(frozen=True)
class Unknown:
    """law: its equation. at: kinds of places. aliases: it is unknown only to libraries without these names.

    reversing: shows only where the flow turns round.
    """

    law: str
    at: tuple[str, ...]
    numbers: Callable[[NominalRun, str], dict[str, float]]
    aliases: tuple[str, ...]
    reversing: bool = False

    def draw(self, s: NominalRun, place: str) -> Deviation:
        return Deviation("unknown", place, self.law, self.numbers(s, place))


def _pulsating(s: NominalRun, at: str) -> dict[str, float]:
    return {"depth": s.size(0.15, 0.3), "period": s.uniform(40, 160)}


def _backlash(s: NominalRun, at: str) -> dict[str, float]:
    low, high = s.pump(at)
    return {"slack": s.size(0.08, 0.16) * (high - low)}


def _sticking(s: NominalRun, at: str) -> dict[str, float]:
    low, high = s.pump(at)
    return {"stiction": s.size(0.25, 0.4) * (high - low)}


def _tiring(s: NominalRun, at: str) -> dict[str, float]:
    return {"loss": s.size(0.3, 0.5), "tau": s.uniform(250, 700), "rated": s.pump(at)[1]}


def _stalling(s: NominalRun, at: str) -> dict[str, float]:
    return {"rest": 1 - s.size(0.4, 0.7), "period": s.uniform(0.2, 0.35) * s.seconds}


def _sputtering(s: NominalRun, at: str) -> dict[str, float]:
    return {"rest": 1 - s.size(0.3, 0.6), "period": s.uniform(200, 600)}


def _bent(s: NominalRun, at: str) -> dict[str, float]:
    return {"bow": s.either(0.08, 0.16), "rated": s.pump(at)[1]}


def _slewing(s: NominalRun, at: str) -> dict[str, float]:
    low, high = s.pump(at)
    return {"rate": (high - low) / s.size(90, 180)}


def _silting(s: NominalRun, at: str) -> dict[str, float]:
    q = s.conductance_of(at) * s.head(at, 0.5) ** 0.5
    return {"slow": q, "loss": s.size(0.25, 0.4), "settle": s.uniform(200, 400), "wash": s.uniform(60, 150)}


def _two_regimes(s: NominalRun, at: str) -> dict[str, float]:
    return {"low": s.head(at, 0.35), "high": s.head(at, 0.7), "loss": s.size(0.15, 0.28)}


def _fluttering(s: NominalRun, at: str) -> dict[str, float]:
    return {"loss": s.size(0.25, 0.4), "period": s.uniform(150, 450)}


def _check_valve(s: NominalRun, at: str) -> dict[str, float]:
    return {"one_way": 1.0}


def _choked(s: NominalRun, at: str) -> dict[str, float]:
    return {"most": (1.4 - s.size(0.1, 0.3)) * s.conductance_of(at) * s.head(at, 0.6) ** 0.5}


def _blocked_at_times(s: NominalRun, at: str) -> dict[str, float]:
    return {"loss": s.size(0.25, 0.45), "period": s.uniform(300, 900)}


def _lopsided(s: NominalRun, at: str) -> dict[str, float]:
    return {"change": s.either(0.2, 0.35)}


def _gulping(s: NominalRun, at: str) -> dict[str, float]:
    return {"head": s.head(at, s.uniform(0.3, 0.5)), "loss": s.size(0.15, 0.3)}


def _siphon(s: NominalRun, at: str) -> dict[str, float]:
    conductance = s.size(0.15, 0.3) * s.conductance_at(at)
    return {"bend": s.tank(at, 0.75), "mouth": s.tank(at, 0.3), "conductance": conductance}


def _cycling_user(s: NominalRun, at: str) -> dict[str, float]:
    return {"draw": s.size(0.12, 0.22) * float(np.max(s.asked)), "period": s.uniform(180, 500)}


def _float_valve(s: NominalRun, at: str) -> dict[str, float]:
    flow = s.size(0.12, 0.22) * float(np.max(s.asked))
    return {"low": s.tank(at, 0.3), "high": s.tank(at, 0.7), "flow": flow}


def _side_chamber(s: NominalRun, at: str) -> dict[str, float]:
    tank = next(t for t in s.plant.tanks if t.name == at)
    return {"area": s.size(0.25, 0.5) * tank.area, "tau": s.uniform(60, 200)}


def _splashing_in(s: NominalRun, at: str) -> dict[str, float]:
    return {"flow": s.size(0.12, 0.22) * float(np.max(s.asked)), "period": s.uniform(250, 700)}


def _bowed(s: NominalRun, at: str) -> dict[str, float]:
    tank = s.tank_of(at)
    return {"low": s.tank(tank, 0.02), "high": s.tank(tank, 0.98), "bow": s.either(0.06, 0.12) * s.span(tank)}


def _sticking_float(s: NominalRun, at: str) -> dict[str, float]:
    return {"slack": s.size(0.04, 0.08) * s.span(s.tank_of(at))}


def _humming(s: NominalRun, at: str) -> dict[str, float]:
    return {"height": s.size(0.03, 0.06) * s.span(s.tank_of(at)), "period": s.uniform(50, 250)}


def _freezing(s: NominalRun, at: str) -> dict[str, float]:
    return {"period": s.uniform(150, 400)}


def _bursting(s: NominalRun, at: str) -> dict[str, float]:
    seed, height = float(s.rng.integers(2**31)), s.size(0.03, 0.07) * s.span(s.tank_of(at))
    return {"seed": seed, "chance": s.uniform(0.01, 0.03), "height": height}


def _jumped(s: NominalRun, at: str) -> dict[str, float]:
    return {"offset": s.either(0.05, 0.1) * s.span(s.tank_of(at)), "onset": s.uniform(0.25, 0.75) * s.seconds}


def _kinked(s: NominalRun, at: str) -> dict[str, float]:
    return {"knee": s.tank(s.tank_of(at), s.uniform(0.35, 0.65)), "extra": s.either(0.2, 0.45)}


def _leading(s: NominalRun, at: str) -> dict[str, float]:
    return {"ahead": s.size(12, 30)}


def _wandering(s: NominalRun, at: str) -> dict[str, float]:
    return {"height": s.size(0.08, 0.15) * s.span(s.tank_of(at)), "period": s.uniform(600, 1500)}


UNKNOWN = (
    Unknown("pulsating", (PUMP,), _pulsating, ("pump_oscillation",)),
    Unknown("backlash", (PUMP,), _backlash, ("pump_backlash",)),
    Unknown("sticking", (PUMP,), _sticking, ("pump_stiction",)),
    Unknown("tiring", (PUMP,), _tiring, ("pump_derating",)),
    Unknown("stalling", (PUMP,), _stalling, ("pump_stall",)),
    Unknown("sputtering", (PUMP,), _sputtering, ("pump_air",)),
    Unknown("bent", (PUMP,), _bent, ("pump_curve",)),
    Unknown("slewing", (PUMP,), _slewing, ("actuator_slew",)),
    Unknown("silting", (PIPE, OUTLET), _silting, ("silting",)),
    Unknown("two_regimes", (PIPE, OUTLET), _two_regimes, ("flow_hysteresis",)),
    Unknown("fluttering", (PIPE, OUTLET), _fluttering, ("coefficient_ripple",)),
    Unknown("check_valve", (PIPE,), _check_valve, ("check_valve",), reversing=True),
    Unknown("choked", (PIPE, OUTLET), _choked, ("flow_limit",)),
    Unknown("blocked_at_times", (PIPE, OUTLET), _blocked_at_times, ("intermittent_blockage",)),
    Unknown("lopsided", (PIPE,), _lopsided, ("flow_asymmetry",), reversing=True),
    Unknown("gulping", (OUTLET,), _gulping, ("vortex",)),
    Unknown("siphon", (TANK,), _siphon, ("siphon",)),
    Unknown("cycling_user", (TANK,), _cycling_user, ("periodic_draw",)),
    Unknown("float_valve", (TANK,), _float_valve, ("float_valve",)),
    Unknown("side_chamber", (TANK,), _side_chamber, ("side_chamber",)),
    Unknown("splashing_in", (TANK,), _splashing_in, ("periodic_draw",)),
    Unknown("bowed", (SENSOR,), _bowed, ("sensor_curvature",)),
    Unknown("sticking_float", (SENSOR,), _sticking_float, ("sensor_hysteresis",)),
    Unknown("humming", (SENSOR,), _humming, ("sensor_oscillation",)),
    Unknown("bursting", (SENSOR,), _bursting, ("sensor_outliers",)),
    Unknown("jumped", (SENSOR,), _jumped, ("sensor_jump",)),
    Unknown("kinked", (SENSOR,), _kinked, ("sensor_kink",)),
    Unknown("leading", (SENSOR,), _leading, ("sensor_lead",)),
    Unknown("wandering", (SENSOR,), _wandering, ("sensor_wander",)),
    Unknown("freezing", (SENSOR,), _freezing, ("sensor_stuck",)),
)


def unknown_to(library: Collection[str]) -> tuple[Unknown, ...]:
    """The laws that a library of these effects does not contain."""
    left = tuple(u for u in UNKNOWN if not set(u.aliases) & set(library))
    if not left:
        raise ValueError(
            "expected a library that lacks some effect, got one that names all; leave 'unknown' out of kinds"
        )
    return left
