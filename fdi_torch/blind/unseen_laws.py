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

    numbers: draws the law's parameters from the nominal run and the place. reversing: shows only where the flow turns
    round.
    """

    law: str
    at: tuple[str, ...]
    aliases: tuple[str, ...]
    numbers: Callable[[NominalRun, str], dict[str, float]]
    reversing: bool = False

    def draw(self, s: NominalRun, place: str) -> Deviation:
        return Deviation("unknown", place, self.law, self.numbers(s, place))


UNKNOWN = (
    Unknown("pulsating", (PUMP,), ("pump_oscillation",),
            lambda s, at: {"depth": s.size(0.15, 0.3), "period": s.uniform(40, 160)}),
    Unknown("backlash", (PUMP,), ("pump_backlash",), lambda s, at: {"slack": s.size(0.08, 0.16) * s.pump_range(at)}),
    Unknown("sticking", (PUMP,), ("pump_stiction",), lambda s, at: {"stiction": s.size(0.25, 0.4) * s.pump_range(at)}),
    Unknown("tiring", (PUMP,), ("pump_derating",),
            lambda s, at: {"loss": s.size(0.3, 0.5), "tau": s.uniform(250, 700), "rated": s.pump(at)[1]}),
    Unknown("stalling", (PUMP,), ("pump_stall",),
            lambda s, at: {"rest": 1 - s.size(0.4, 0.7), "period": s.uniform(0.2, 0.35) * s.seconds}),
    Unknown("sputtering", (PUMP,), ("pump_air",),
            lambda s, at: {"rest": 1 - s.size(0.3, 0.6), "period": s.uniform(200, 600)}),
    Unknown("bent", (PUMP,), ("pump_curve",), lambda s, at: {"bow": s.either(0.08, 0.16), "rated": s.pump(at)[1]}),
    Unknown("slewing", (PUMP,), ("actuator_slew",), lambda s, at: {"rate": s.pump_range(at) / s.size(90, 180)}),
    Unknown("silting", (PIPE, OUTLET), ("silting",),
            lambda s, at: {"slow": s.conductance_of(at) * s.head(at, 0.5) ** 0.5, "loss": s.size(0.25, 0.4),
                          "settle": s.uniform(200, 400), "wash": s.uniform(60, 150)}),
    Unknown("two_regimes", (PIPE, OUTLET), ("flow_hysteresis",),
            lambda s, at: {"low": s.head(at, 0.35), "high": s.head(at, 0.7), "loss": s.size(0.15, 0.28)}),
    Unknown("fluttering", (PIPE, OUTLET), ("coefficient_ripple",),
            lambda s, at: {"loss": s.size(0.25, 0.4), "period": s.uniform(150, 450)}),
    Unknown("check_valve", (PIPE,), ("check_valve",), lambda s, at: {"one_way": 1.0}, reversing=True),
    Unknown("choked", (PIPE, OUTLET), ("flow_limit",),
            lambda s, at: {"most": (1.4 - s.size(0.1, 0.3)) * s.conductance_of(at) * s.head(at, 0.6) ** 0.5}),
    Unknown("blocked_at_times", (PIPE, OUTLET), ("intermittent_blockage",),
            lambda s, at: {"loss": s.size(0.25, 0.45), "period": s.uniform(300, 900)}),
    Unknown("lopsided", (PIPE,), ("flow_asymmetry",), lambda s, at: {"change": s.either(0.2, 0.35)}, reversing=True),
    Unknown("gulping", (OUTLET,), ("vortex",),
            lambda s, at: {"head": s.head(at, s.uniform(0.3, 0.5)), "loss": s.size(0.15, 0.3)}),
    Unknown("siphon", (TANK,), ("siphon",),
            lambda s, at: {"conductance": s.size(0.15, 0.3) * s.conductance_at(at), "bend": s.tank(at, 0.75),
                          "mouth": s.tank(at, 0.3)}),
    Unknown("cycling_user", (TANK,), ("periodic_draw",),
            lambda s, at: {"draw": s.size(0.12, 0.22) * float(np.max(s.asked)), "period": s.uniform(180, 500)}),
    Unknown("float_valve", (TANK,), ("float_valve",),
            lambda s, at: {"flow": s.size(0.12, 0.22) * float(np.max(s.asked)), "low": s.tank(at, 0.3),
                          "high": s.tank(at, 0.7)}),
    Unknown("side_chamber", (TANK,), ("side_chamber",),
            lambda s, at: {"area": s.size(0.25, 0.5) * s.area(at), "tau": s.uniform(60, 200)}),
    Unknown("splashing_in", (TANK,), ("periodic_draw",),
            lambda s, at: {"flow": s.size(0.12, 0.22) * float(np.max(s.asked)), "period": s.uniform(250, 700)}),
    Unknown("bowed", (SENSOR,), ("sensor_curvature",),
            lambda s, at: {"low": s.tank(s.tank_of(at), 0.02), "high": s.tank(s.tank_of(at), 0.98),
                          "bow": s.either(0.06, 0.12) * s.span(s.tank_of(at))}),
    Unknown("sticking_float", (SENSOR,), ("sensor_hysteresis",),
            lambda s, at: {"slack": s.size(0.04, 0.08) * s.span(s.tank_of(at))}),
    Unknown("humming", (SENSOR,), ("sensor_oscillation",),
            lambda s, at: {"height": s.size(0.03, 0.06) * s.span(s.tank_of(at)), "period": s.uniform(50, 250)}),
    Unknown("bursting", (SENSOR,), ("sensor_outliers",),
            lambda s, at: {"seed": float(s.rng.integers(2**31)),
                          "height": s.size(0.03, 0.07) * s.span(s.tank_of(at)), "chance": s.uniform(0.01, 0.03)}),
    Unknown("jumped", (SENSOR,), ("sensor_jump",),
            lambda s, at: {"offset": s.either(0.05, 0.1) * s.span(s.tank_of(at)),
                          "onset": s.uniform(0.25, 0.75) * s.seconds}),
    Unknown("kinked", (SENSOR,), ("sensor_kink",),
            lambda s, at: {"knee": s.tank(s.tank_of(at), s.uniform(0.35, 0.65)), "extra": s.either(0.2, 0.45)}),
    Unknown("leading", (SENSOR,), ("sensor_lead",), lambda s, at: {"ahead": s.size(12, 30)}),
    Unknown("wandering", (SENSOR,), ("sensor_wander",),
            lambda s, at: {"height": s.size(0.08, 0.15) * s.span(s.tank_of(at)), "period": s.uniform(600, 1500)}),
    Unknown("freezing", (SENSOR,), ("sensor_stuck",), lambda s, at: {"period": s.uniform(150, 400)}),
)  # fmt: skip


def unknown_to(library: Collection[str]) -> tuple[Unknown, ...]:
    """The laws that a library of these effects does not contain."""
    left = tuple(u for u in UNKNOWN if not set(u.aliases) & set(library))
    if not left:
        raise ValueError(
            "expected a library that lacks some effect, got one that names all; leave 'unknown' out of kinds"
        )
    return left
