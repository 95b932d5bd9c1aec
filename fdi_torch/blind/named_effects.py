"""Random draws of each named effect for a hidden rig: its law, its parameters and its usual strength.

The size of an effect is drawn relative to the flows and levels of the sound rig under the inputs of the recording, its
nominal run, so that thresholds are crossed. Each function draws one effect: s is the run of the sound rig, with the
random numbers; at is the place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdi_torch.blind.deviation import Array, Deviation
from fdi_torch.blind.simulator import conductance
from fdi_torch.plant.description import PlantDescription


@dataclass(frozen=True)
class NominalRun:
    """Run of a case's rig without deviations.

    plant: as built. levels (T, N) m and asked (T, M) m^3/s: levels and requested flows of the recording. strength: of
    the effects, 1 usual, 0.2 weak. rng: random generator of the case.
    """

    plant: PlantDescription
    levels: Array
    asked: Array
    strength: float
    rng: np.random.Generator

    @property
    def most_asked(self) -> float:
        """Highest flow requested from any pump, m^3/s."""
        return float(np.max(self.asked))

    @property
    def seconds(self) -> float:
        return float(len(self.levels) - 1)

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def size(self, low: float, high: float) -> float:
        """A size in its usual range, times the strength."""
        return self.strength * self.uniform(low, high)

    def either(self, low: float, high: float) -> float:
        """A size with random sign."""
        return self.size(low, high) * (1.0 if self.rng.random() < 0.5 else -1.0)

    def one_of(self, *laws: str) -> str:
        return laws[int(self.rng.integers(len(laws)))]

    def pump(self, name: str) -> tuple[float, float]:
        """Lowest and highest flow requested from the pump, m^3/s."""
        column = self.asked[:, [p.name for p in self.plant.pumps].index(name)]
        return float(column.min()), float(column.max())

    def pump_range(self, name: str) -> float:
        """Difference of the highest and lowest flow requested from the pump, m^3/s."""
        low, high = self.pump(name)
        return high - low

    def tank(self, at: str, share: float) -> float:
        """The level below which a tank is for this share of the time, m. at: the tank, its sensor or a pump into it."""
        component = self.plant.component(at)
        name = getattr(component, "tank", None) or getattr(component, "target", at)
        column = self.levels[:, [t.name for t in self.plant.tanks].index(str(name))]
        return float(np.quantile(column, share))

    def span(self, at: str) -> float:
        """Range of a tank's level without its lowest and highest 2 %, m. at: as for `tank`."""
        return self.tank(at, 0.98) - self.tank(at, 0.02)

    def head(self, pipe: str, share: float) -> float:
        """The quantile of the pipe's driving head, m: it is below this for that share of the time."""
        tanks = [t.name for t in self.plant.tanks]
        p = self.plant.pipe(pipe)
        head = self.levels[:, tanks.index(p.source)] - p.elevation
        if not p.is_outlet:
            head = head - (self.levels[:, tanks.index(p.target)] - p.elevation)
        return float(np.quantile(np.abs(head), share))

    def conductance_of(self, pipe: str) -> float:
        """Discharge coefficient x bore x sqrt(2 g) of a pipe, m^2.5/s."""
        return float(conductance(self.plant)[[p.name for p in self.plant.pipes].index(pipe)])

    def conductance_at(self, tank: str) -> float:
        """Conductance of the pipe with which a leak of this tank is compared, m^2.5/s."""
        touching = [p.name for p in self.plant.pipes if tank in (p.source, p.target)]
        return self.conductance_of(self.plant.tank(tank).leak_reference or touching[0])


Drawn = tuple[Any, ...]  # name of the law, its numbers and, for a flow between tanks, the second tank


def pump_dead_zone(s: NominalRun, at: str) -> Drawn:
    zone = s.size(0.06, 0.13) * s.pump(at)[1]
    law = s.one_of("threshold", "soft_threshold")
    return law, {"zone": zone} | ({"knee": 0.15 * zone} if "soft" in law else {})


def pump_saturation(s: NominalRun, at: str) -> Drawn:
    limit = s.pump(at)[1] - s.size(0.28, 0.5) * s.pump_range(at)
    return s.one_of("hard_limit", "rounded_limit"), {"limit": limit}


def pump_back_pressure(s: NominalRun, at: str) -> Drawn:
    loss, high = s.size(0.1, 0.22), s.tank(at, 0.98)
    law = s.one_of("shut_off_head", "falling", "drooping")
    share = {"shut_off_head": 1 - (1 - loss) ** 2, "falling": loss, "drooping": loss**0.5}[law]
    return law, {"head": high / share}


def laminar_flow(s: NominalRun, at: str) -> Drawn:
    """The size is the share of flow lost at the median head, f = 1 - size, solved for the law's head."""
    law = s.one_of("viscous_and_inertial", "reynolds_blend", "sharp_transition")
    kept = 1 - s.size(0.07, 0.22)
    if law == "sharp_transition":
        return law, {"head": s.head(at, 0.1 + 2 * (1 - kept))}
    ratio = (1 / kept - kept) ** 2 if law == "viscous_and_inertial" else np.arctanh(kept) ** -2
    return law, {"head": float(ratio) * s.head(at, 0.5)}


def outlet_drop(s: NominalRun, at: str) -> Drawn:
    share = s.either(0.08, 0.18)
    return "down_pipe", {"drop": share * s.head(at, 0.5 if share > 0 else 0.05)}


def plugging(s: NominalRun, at: str) -> Drawn:
    """From the start if strong, otherwise from some time on, because a small one from the start is within tolerance."""
    sudden = s.strength < 0.5 or s.rng.random() < 0.5
    onset = s.uniform(0.12, 0.5) * s.seconds if sudden else -1e9
    return "narrowed", {"loss": s.either(0.14, 0.28), "onset": onset, "ramp": s.uniform(1.0, 40.0)}


def cross_flow(s: NominalRun, at: str) -> Drawn:
    first, second = at.split("-")
    numbers = {"conductance": s.size(0.08, 0.25) * s.conductance_at(first)}
    law = s.one_of("slot", "window")
    numbers |= {"viscous": 1e-3} if law == "slot" else {"height": 0.3 * s.tank(first, 0.05)}
    return law, numbers, second


def leak(s: NominalRun, at: str) -> Drawn:
    conductance = s.size(0.08, 0.25) * s.conductance_at(at)
    if s.rng.random() < 0.5:
        return "floor_hole", {"conductance": conductance}
    height = s.uniform(0.1, 0.6) * s.tank(at, 0.5)
    return "hole", {"conductance": 1.4 * conductance, "height": height, "bore": s.uniform(0.01, 0.06) * s.span(at)}


def unmetered_flow(s: NominalRun, at: str) -> Drawn:
    begin = s.uniform(0.08, 0.35) * s.seconds
    end = begin + s.uniform(0.2, 0.5) * s.seconds
    draw = s.either(0.07, 0.16) * s.most_asked
    return "tapped", {"draw": draw, "begin": begin, "end": end, "ramp": s.uniform(1.0, 20.0)}


def area_taper(s: NominalRun, at: str) -> Drawn:
    """The nominal cross-section is that at the floor, or that at half height."""
    slope = ((1 + s.either(0.15, 0.4)) ** 0.5 - 1) / s.tank(at, 0.98)
    half = 0.5 * s.plant.tank(at).height if s.rng.random() < 0.5 else 0.0
    return s.one_of("cone", "wedge"), {"slope": slope, "reference": half}


def internal_body(s: NominalRun, at: str) -> Drawn:
    numbers = {"low": s.tank(at, s.uniform(0.05, 0.3)), "high": s.tank(at, s.uniform(0.7, 0.95))}
    law = s.one_of("block", "barrel", "heap")
    return law, numbers | {"share": s.size(0.2, 0.45)} | ({"chamfer": s.uniform(0.05, 0.2)} if law == "block" else {})


def overflow(s: NominalRun, at: str) -> Drawn:
    law = s.one_of("rectangular_weir", "notched_weir", "brim")
    deep = {"rectangular_weir": 0.05, "notched_weir": 0.12, "brim": 0.02}[law]
    crest = s.tank(at, 0.98) - s.size(0.25, 0.5) * s.span(at)
    others = [t.name for t in s.plant.tanks if t.name != at]
    into = others[int(s.rng.integers(len(others)))] if others and s.rng.random() < 0.25 else None
    return law, {"crest": crest, "depth": deep * s.span(at), "flow": s.most_asked}, into


def sensor_saturation(s: NominalRun, at: str) -> Drawn:
    ceiling = s.tank(at, 0.98) - s.size(0.25, 0.5) * s.span(at)
    return s.one_of("clipped", "clipped_reading"), {"ceiling": ceiling}


_DRIFTS = ("drifting_evenly", "drifting_to_rest", "drifting_as_sine", "drifting_unevenly")
DRAWS: dict[str, Callable[[NominalRun, str], Drawn]] = {
    "pump_gain": lambda s, at: ("scaled", {"gain": 1 + s.either(0.08, 0.20)}),
    "pump_dead_zone": pump_dead_zone,
    "pump_saturation": pump_saturation,
    "pump_lag": lambda s, at: (s.one_of("slow", "slow_in_two_poles"), {"tau": s.size(7, 25)}),
    "pump_delay": lambda s, at: (s.one_of("late", "late_and_smeared", "late_and_slow"), {"delay": s.size(5, 15)}),
    "pump_back_pressure": pump_back_pressure,
    "laminar_flow": laminar_flow,
    "flow_exponent": lambda s, at: (
        "other_power",
        {"power": 0.5 + s.either(0.07, 0.16), "reference": s.uniform(0.6, 1.6) * s.head(at, 0.5)},
    ),
    "outlet_drop": outlet_drop,
    "coefficient_drift": lambda s, at: (s.one_of(*_DRIFTS), {"change": s.either(0.1, 0.25), "span": s.seconds}),
    "plugging": plugging,
    "cross_flow": cross_flow,
    "leak": leak,
    "unmetered_flow": unmetered_flow,
    "area_taper": area_taper,
    "internal_body": internal_body,
    "overflow": overflow,
    "sensor_bias": lambda s, at: ("offset", {"offset": s.either(0.04, 0.1) * s.span(at)}),
    "sensor_gain": lambda s, at: ("stretched", {"gain": 1 + s.either(0.05, 0.12)}),
    "sensor_lag": lambda s, at: (s.one_of("damped", "damped_twice"), {"tau": s.size(10, 35)}),
    "sensor_drift": lambda s, at: ("creeping", {"rate": s.either(0.06, 0.15) * s.span(at) / s.seconds}),
    "sensor_quantization": lambda s, at: ("rounded", {"step": s.size(0.03, 0.08) * s.span(at)}),
    "sensor_delay": lambda s, at: ("late_reading", {"delay": s.size(6, 18)}),
    "sensor_saturation": sensor_saturation,
}


def draw_effect(effect: str, s: NominalRun, at: str) -> Deviation:
    """The deviation of an effect of the library at a place, with its size drawn for a nominal run."""
    return Deviation(effect, at, *DRAWS[effect](s, at))
