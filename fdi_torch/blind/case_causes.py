"""The choice of causes for a case of each kind (names and locations, without numbers), and how each law outside the
library is drawn.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from fdi_torch.blind.deviation import Deviation
from fdi_torch.blind.kinds import Kind
from fdi_torch.blind.named_effects import NominalRun
from fdi_torch.blind.places import (
    EFFECTS,
    OUTLET,
    PIPE,
    PUMP,
    SENSOR,
    TANK,
    TWINS,
    Cause,
    are_twins,
    canonical,
    effect_places,
    places,
)
from fdi_torch.blind.plants import Rig
from fdi_torch.plant.description import PlantDescription


@dataclass(frozen=True)
class Chosen:
    """The causes of a case: the first `full` have full size, others are faint. `unknown`: a law outside the library."""

    causes: tuple[Cause, ...] = ()
    full: int = 0
    unknown: Unknown | None = None
    place: str = ""
    leave_out: tuple[str, ...] = ()


def case_generator(seed: int, kind: str, index: int, *more: int) -> np.random.Generator:
    """Random generator of one case, independent of all other cases and of their number."""
    return np.random.default_rng([seed, zlib.crc32(kind.encode()), index, *more])


def in_turn(items: Sequence[str], seed: int, kind: str, index: int) -> str:
    """The item at this index of a sequence of shuffled rounds, so that all items are equally frequent."""
    turn, at = divmod(index, len(items))
    order = case_generator(seed, kind, turn, 1).permutation(len(items))
    return items[int(order[at])]


def choose(
    kind: Kind, rig: Rig, seed: int, index: int, library: Collection[str], leave_out: Sequence[str], trial: int = 0
) -> Chosen:
    """The causes of case `index` of this kind. trial: number of earlier draws whose causes were not visible."""
    rng, plant = case_generator(seed, kind.name, index, 2, *([trial] if trial else [])), rig.plant
    if kind.name == "twins":
        families = [(effects, places(plant, (at,))) for effects, at in TWINS if places(plant, (at,))]
        effects, at = families[index % len(families)]
        return Chosen(((str(rng.choice(effects)), str(rng.choice(at))),), 1)
    if kind.name == "left_out":
        return _left_out(plant, seed, index, leave_out, rng)

    def _chosen(names: Sequence[str]) -> str:
        return in_turn(names, seed, kind.name, index) if trial < 2 else str(rng.choice(names))

    causes: list[Cause] = []
    full = kind.causes + (int(rng.integers(kind.perhaps + 1)) if kind.perhaps else 0)
    if full:
        present = [e for e in EFFECTS if places(plant, EFFECTS[e])]
        effect = _chosen(present)
        causes.append((effect, str(rng.choice(places(plant, EFFECTS[effect])))))
    while len(causes) < full + kind.faint:
        others = [c for c in effect_places(plant) if all(c[0] != o[0] and not are_twins(c, o, plant) for o in causes)]
        causes.append(others[int(rng.integers(len(others)))])
    if not kind.unseen:
        return Chosen(tuple(causes), full)
    laws = {u.law: u for u in unknown_to(library) if places(plant, u.at)}
    # Laws that need reversing flow require inputs that are at rest for a while.
    if kind.inputs != "rich" or all(p.is_outlet for p in plant.pipes):
        laws = {name: u for name, u in laws.items() if not u.reversing}
    unknown = laws[_chosen(sorted(laws))]
    free = [p for p in places(plant, unknown.at) if all(p not in place.split("-") for _, place in causes)]
    return Chosen(tuple(causes), full, unknown, str(rng.choice(free or places(plant, unknown.at))))


def _left_out(
    plant: PlantDescription, seed: int, index: int, leave_out: Sequence[str], rng: np.random.Generator
) -> Chosen:
    """An effect to leave out of the library, for which no equivalent effect remains in it."""
    alike = {canonical(c, plant) for c in effect_places(plant) if canonical(c, plant) != c}
    candidates = {e: places(plant, EFFECTS.get(e, ())) for e in leave_out}
    free = {e: [p for p in at if canonical((e, p), plant) not in alike] for e, at in candidates.items()}
    possible = [e for e in leave_out if free[e]]
    if not possible:
        raise ValueError("expected an effect to leave out that has a place in this plant, got none; name one")
    effect = in_turn(possible, seed, "left_out", index)
    return Chosen(((effect, str(rng.choice(free[effect]))),), 1, leave_out=(effect,))


@dataclass(frozen=True)
class Unknown:
    """law: its equation. at: kinds of places. effect: it is unknown only to libraries without this effect.

    numbers: draws the law's parameters from the nominal run and the place. reversing: shows only where the flow turns
    round.
    """

    law: str
    at: tuple[str, ...]
    effect: str
    numbers: Callable[[NominalRun, str], dict[str, float]]
    reversing: bool = False

    def draw(self, s: NominalRun, place: str) -> Deviation:
        return Deviation("unknown", place, self.law, self.numbers(s, place))


UNKNOWN = (
    Unknown("pulsating", (PUMP,), "pump_oscillation",
            lambda s, at: {"depth": s.size(0.15, 0.3), "period": s.uniform(40, 160)}),
    Unknown("backlash", (PUMP,), "pump_backlash", lambda s, at: {"slack": s.size(0.08, 0.16) * s.pump_range(at)}),
    Unknown("sticking", (PUMP,), "pump_stiction", lambda s, at: {"stiction": s.size(0.25, 0.4) * s.pump_range(at)}),
    Unknown("tiring", (PUMP,), "pump_derating",
            lambda s, at: {"loss": s.size(0.3, 0.5), "tau": s.uniform(250, 700), "rated": s.pump(at)[1]}),
    Unknown("stalling", (PUMP,), "pump_stall",
            lambda s, at: {"rest": 1 - s.size(0.4, 0.7), "period": s.uniform(0.2, 0.35) * s.seconds}),
    Unknown("sputtering", (PUMP,), "pump_air",
            lambda s, at: {"rest": 1 - s.size(0.3, 0.6), "period": s.uniform(200, 600)}),
    Unknown("bent", (PUMP,), "pump_curve", lambda s, at: {"bow": s.either(0.08, 0.16), "rated": s.pump(at)[1]}),
    Unknown("slewing", (PUMP,), "actuator_slew", lambda s, at: {"rate": s.pump_range(at) / s.size(90, 180)}),
    Unknown("silting", (PIPE, OUTLET), "silting",
            lambda s, at: {"slow": s.conductance_of(at) * s.head(at, 0.5) ** 0.5, "loss": s.size(0.25, 0.4),
                           "settle": s.uniform(200, 400), "wash": s.uniform(60, 150)}),
    Unknown("two_regimes", (PIPE, OUTLET), "flow_hysteresis",
            lambda s, at: {"low": s.head(at, 0.35), "high": s.head(at, 0.7), "loss": s.size(0.15, 0.28)}),
    Unknown("fluttering", (PIPE, OUTLET), "coefficient_ripple",
            lambda s, at: {"loss": s.size(0.25, 0.4), "period": s.uniform(150, 450)}),
    Unknown("check_valve", (PIPE,), "check_valve", lambda s, at: {"one_way": 1.0}, reversing=True),
    Unknown("choked", (PIPE, OUTLET), "flow_limit",
            lambda s, at: {"most": (1.4 - s.size(0.1, 0.3)) * s.conductance_of(at) * s.head(at, 0.6) ** 0.5}),
    Unknown("blocked_at_times", (PIPE, OUTLET), "intermittent_blockage",
            lambda s, at: {"loss": s.size(0.25, 0.45), "period": s.uniform(300, 900)}),
    Unknown("lopsided", (PIPE,), "flow_asymmetry", lambda s, at: {"change": s.either(0.2, 0.35)}, reversing=True),
    Unknown("gulping", (OUTLET,), "vortex",
            lambda s, at: {"head": s.head(at, s.uniform(0.3, 0.5)), "loss": s.size(0.15, 0.3)}),
    Unknown("siphon", (TANK,), "siphon",
            lambda s, at: {"conductance": s.size(0.15, 0.3) * s.conductance_at(at), "bend": s.tank(at, 0.75),
                           "mouth": s.tank(at, 0.3)}),
    Unknown("cycling_user", (TANK,), "periodic_draw",
            lambda s, at: {"draw": s.size(0.12, 0.22) * s.most_asked, "period": s.uniform(180, 500)}),
    Unknown("float_valve", (TANK,), "float_valve",
            lambda s, at: {"flow": s.size(0.12, 0.22) * s.most_asked, "low": s.tank(at, 0.3), "high": s.tank(at, 0.7)}),
    Unknown("side_chamber", (TANK,), "side_chamber",
            lambda s, at: {"area": s.size(0.25, 0.5) * s.plant.tank(at).area, "tau": s.uniform(60, 200)}),
    Unknown("splashing_in", (TANK,), "periodic_draw",
            lambda s, at: {"flow": s.size(0.12, 0.22) * s.most_asked, "period": s.uniform(250, 700)}),
    Unknown("bowed", (SENSOR,), "sensor_curvature",
            lambda s, at: {"low": s.tank(at, 0.02), "high": s.tank(at, 0.98),
                           "bow": s.either(0.06, 0.12) * s.span(at)}),
    Unknown("sticking_float", (SENSOR,), "sensor_hysteresis", lambda s, at: {"slack": s.size(0.04, 0.08) * s.span(at)}),
    Unknown("humming", (SENSOR,), "sensor_oscillation",
            lambda s, at: {"height": s.size(0.03, 0.06) * s.span(at), "period": s.uniform(50, 250)}),
    Unknown("bursting", (SENSOR,), "sensor_outliers",
            lambda s, at: {"seed": float(s.rng.integers(2**31)), "height": s.size(0.03, 0.07) * s.span(at),
                           "chance": s.uniform(0.01, 0.03)}),
    Unknown("jumped", (SENSOR,), "sensor_jump",
            lambda s, at: {"offset": s.either(0.05, 0.1) * s.span(at), "onset": s.uniform(0.25, 0.75) * s.seconds}),
    Unknown("kinked", (SENSOR,), "sensor_kink",
            lambda s, at: {"knee": s.tank(at, s.uniform(0.35, 0.65)), "extra": s.either(0.2, 0.45)}),
    Unknown("leading", (SENSOR,), "sensor_lead", lambda s, at: {"ahead": s.size(12, 30)}),
    Unknown("wandering", (SENSOR,), "sensor_wander",
            lambda s, at: {"height": s.size(0.08, 0.15) * s.span(at), "period": s.uniform(600, 1500)}),
    Unknown("freezing", (SENSOR,), "sensor_stuck", lambda s, at: {"period": s.uniform(150, 400)}),
)  # fmt: skip


def unknown_to(library: Collection[str]) -> tuple[Unknown, ...]:
    """The laws that a library of these effects does not contain."""
    outside = tuple(u for u in UNKNOWN if u.effect not in library)
    if not outside:
        raise ValueError(
            "expected a library that lacks some effect, got one that names all; leave 'unknown' out of kinds"
        )
    return outside
