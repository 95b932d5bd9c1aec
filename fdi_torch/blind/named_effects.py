"""Random draws of each named effect for a hidden rig: its law, its parameters and its usual strength.

The size of an effect is drawn relative to the flows and levels of the sound rig under the inputs of the recording, its
nominal run, so that thresholds are crossed. Each function draws one effect: s is the run of the sound rig, with the
random numbers; at is the place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fdi_torch.blind.deviation import Array, Deviation
from fdi_torch.blind.places import EFFECTS
from fdi_torch.blind.simulator import conductance
from fdi_torch.plant.description import Pipe, PlantDescription, Pump, Sensor


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

    def area(self, tank: str) -> float:
        """Cross-section of the tank, m^2."""
        return self.plant.tank(tank).area

    def tank(self, name: str, share: float) -> float:
        """The level below which the tank is for this share of the time, m."""
        column = self.levels[:, [t.name for t in self.plant.tanks].index(name)]
        return float(np.quantile(column, share))

    def span(self, tank: str) -> float:
        """Range of the tank's level without its lowest and highest 2 %, m."""
        return self.tank(tank, 0.98) - self.tank(tank, 0.02)

    def tank_of(self, location: str) -> str:
        """The tank that a pump feeds, a sensor measures or a pipe drains."""
        component = self.plant.component(location)
        if isinstance(component, Pump):
            return component.target
        if isinstance(component, Pipe):
            return component.source
        return component.tank if isinstance(component, Sensor) else component.name

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


Draw = Callable[[NominalRun, str], Deviation]


def pump_gain(s: NominalRun, at: str) -> Deviation:
    return Deviation("pump_gain", at, "scaled", {"gain": 1 + s.either(0.08, 0.20)})


def pump_dead_zone(s: NominalRun, at: str) -> Deviation:
    zone = s.size(0.06, 0.13) * s.pump(at)[1]
    law = s.one_of("threshold", "soft_threshold")
    return Deviation("pump_dead_zone", at, law, {"zone": zone} | ({"knee": 0.15 * zone} if "soft" in law else {}))


def pump_saturation(s: NominalRun, at: str) -> Deviation:
    low, high = s.pump(at)
    limit = high - s.size(0.28, 0.5) * (high - low)
    return Deviation("pump_saturation", at, s.one_of("hard_limit", "rounded_limit"), {"limit": limit})


def pump_lag(s: NominalRun, at: str) -> Deviation:
    return Deviation("pump_lag", at, s.one_of("slow", "slow_in_two_poles"), {"tau": s.size(7, 25)})


def pump_delay(s: NominalRun, at: str) -> Deviation:
    return Deviation("pump_delay", at, s.one_of("late", "late_and_smeared", "late_and_slow"), {"delay": s.size(5, 15)})


def pump_back_pressure(s: NominalRun, at: str) -> Deviation:
    loss, high = s.size(0.1, 0.22), s.tank(s.tank_of(at), 0.98)
    law = s.one_of("shut_off_head", "falling", "drooping")
    share = {"shut_off_head": 1 - (1 - loss) ** 2, "falling": loss, "drooping": loss**0.5}[law]
    return Deviation("pump_back_pressure", at, law, {"head": high / share})


def laminar_flow(s: NominalRun, at: str) -> Deviation:
    """The size is the share of flow lost at the median head, f = 1 - size, solved for the law's head."""
    law = s.one_of("viscous_and_inertial", "reynolds_blend", "sharp_transition")
    kept = 1 - s.size(0.07, 0.22)
    if law == "sharp_transition":
        return Deviation("laminar_flow", at, law, {"head": s.head(at, 0.1 + 2 * (1 - kept))})
    ratio = (1 / kept - kept) ** 2 if law == "viscous_and_inertial" else np.arctanh(kept) ** -2
    return Deviation("laminar_flow", at, law, {"head": float(ratio) * s.head(at, 0.5)})


def flow_exponent(s: NominalRun, at: str) -> Deviation:
    numbers = {"power": 0.5 + s.either(0.07, 0.16), "reference": s.uniform(0.6, 1.6) * s.head(at, 0.5)}
    return Deviation("flow_exponent", at, "other_power", numbers)


def outlet_drop(s: NominalRun, at: str) -> Deviation:
    share = s.either(0.08, 0.18)
    drop = share * s.head(at, 0.5) if share > 0 else share * s.head(at, 0.05)
    return Deviation("outlet_drop", at, "down_pipe", {"drop": drop})


def coefficient_drift(s: NominalRun, at: str) -> Deviation:
    law = s.one_of("drifting_evenly", "drifting_to_rest", "drifting_as_sine", "drifting_unevenly")
    return Deviation("coefficient_drift", at, law, {"change": s.either(0.1, 0.25), "span": s.seconds})


def plugging(s: NominalRun, at: str) -> Deviation:
    """From the start if strong, otherwise from some time on, because a small one from the start is within tolerance."""
    sudden = s.strength < 0.5 or s.rng.random() < 0.5
    onset = s.uniform(0.12, 0.5) * s.seconds if sudden else -1e9
    return Deviation(
        "plugging", at, "narrowed", {"loss": s.either(0.14, 0.28), "onset": onset, "ramp": s.uniform(1.0, 40.0)}
    )


def cross_flow(s: NominalRun, at: str) -> Deviation:
    first, second = at.split("-")
    numbers = {"conductance": s.size(0.08, 0.25) * s.conductance_at(first)}
    law = s.one_of("slot", "window")
    numbers["viscous" if law == "slot" else "height"] = 1e-3 if law == "slot" else 0.3 * s.tank(first, 0.05)
    return Deviation("cross_flow", at, law, numbers, other=second)


def leak(s: NominalRun, at: str) -> Deviation:
    conductance = s.size(0.08, 0.25) * s.conductance_at(at)
    if s.rng.random() < 0.5:
        return Deviation("leak", at, "floor_hole", {"conductance": conductance})
    height = s.uniform(0.1, 0.6) * s.tank(at, 0.5)
    numbers = {"conductance": 1.4 * conductance, "height": height, "bore": s.uniform(0.01, 0.06) * s.span(at)}
    return Deviation("leak", at, "hole", numbers)


def unmetered_flow(s: NominalRun, at: str) -> Deviation:
    begin = s.uniform(0.08, 0.35) * s.seconds
    end = begin + s.uniform(0.2, 0.5) * s.seconds
    draw = s.either(0.07, 0.16) * float(np.max(s.asked))
    return Deviation(
        "unmetered_flow", at, "tapped", {"draw": draw, "begin": begin, "end": end, "ramp": s.uniform(1.0, 20.0)}
    )


def area_taper(s: NominalRun, at: str) -> Deviation:
    """The nominal cross-section is that at the floor, or that at half height."""
    slope = ((1 + s.either(0.15, 0.4)) ** 0.5 - 1) / s.tank(at, 0.98)
    half = 0.5 * s.plant.tank(at).height if s.rng.random() < 0.5 else 0.0
    return Deviation("area_taper", at, s.one_of("cone", "wedge"), {"slope": slope, "reference": half})


def internal_body(s: NominalRun, at: str) -> Deviation:
    numbers = {"low": s.tank(at, s.uniform(0.05, 0.3)), "high": s.tank(at, s.uniform(0.7, 0.95))}
    law = s.one_of("block", "barrel", "heap")
    numbers |= {"share": s.size(0.2, 0.45)} | ({"chamfer": s.uniform(0.05, 0.2)} if law == "block" else {})
    return Deviation("internal_body", at, law, numbers)


def overflow(s: NominalRun, at: str) -> Deviation:
    law = s.one_of("rectangular_weir", "notched_weir", "brim")
    deep = {"rectangular_weir": 0.05, "notched_weir": 0.12, "brim": 0.02}[law]
    crest = s.tank(at, 0.98) - s.size(0.25, 0.5) * s.span(at)
    numbers = {"crest": crest, "depth": deep * s.span(at), "flow": float(np.max(s.asked))}
    others = [t.name for t in s.plant.tanks if t.name != at]
    into = others[int(s.rng.integers(len(others)))] if others and s.rng.random() < 0.25 else None
    return Deviation("overflow", at, law, numbers, other=into)


def sensor_bias(s: NominalRun, at: str) -> Deviation:
    return Deviation("sensor_bias", at, "offset", {"offset": s.either(0.04, 0.1) * s.span(s.tank_of(at))})


def sensor_gain(s: NominalRun, at: str) -> Deviation:
    return Deviation("sensor_gain", at, "stretched", {"gain": 1 + s.either(0.05, 0.12)})


def sensor_lag(s: NominalRun, at: str) -> Deviation:
    return Deviation("sensor_lag", at, s.one_of("damped", "damped_twice"), {"tau": s.size(10, 35)})


def sensor_drift(s: NominalRun, at: str) -> Deviation:
    rate = s.either(0.06, 0.15) * s.span(s.tank_of(at)) / s.seconds
    return Deviation("sensor_drift", at, "creeping", {"rate": rate})


def sensor_quantization(s: NominalRun, at: str) -> Deviation:
    return Deviation("sensor_quantization", at, "rounded", {"step": s.size(0.03, 0.08) * s.span(s.tank_of(at))})


def sensor_delay(s: NominalRun, at: str) -> Deviation:
    return Deviation("sensor_delay", at, "late_reading", {"delay": s.size(6, 18)})


def sensor_saturation(s: NominalRun, at: str) -> Deviation:
    tank = s.tank_of(at)
    ceiling = s.tank(tank, 0.98) - s.size(0.25, 0.5) * s.span(tank)
    return Deviation("sensor_saturation", at, s.one_of("clipped", "clipped_reading"), {"ceiling": ceiling})


NAMED: dict[str, Draw] = {name: globals()[name] for name in EFFECTS}
"""The function of this file that draws each effect, by its name."""
