"""Sizes of named causes against the truth, where a law of the hidden rigs has a number that is the same quantity as a
parameter of the diagnosis' effect: z = (value - truth) / standard error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from fdi_torch.blind.plants import Scales
from fdi_torch.blind.simulator import conductance
from fdi_torch.blind.statistics import root_mean_square_interval, share_of
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import unit_factor

NORMAL_95 = 1.96

Quantity = tuple[str, str, Callable[[Mapping[str, float], PlantDescription, str, Scales], float]]
"""Name of a parameter, its SI unit, and its true value from a law's numbers, plant, location and scales of the rig."""


def _number(parameter: str, unit: str, value: Callable[[Mapping[str, float]], float]) -> Quantity:
    """A number that only has to be scaled from bench to rig."""

    def at_the_rig(numbers: Mapping[str, float], plant: PlantDescription, at: str, scales: Scales) -> float:
        factors = {"s": scales.time, "1/s": 1 / scales.time, "m": scales.length, "m/s": scales.length / scales.time}
        return value(numbers) * (factors | {"m^3/s": scales.flow, "m^2": scales.area, "1": 1.0})[unit]

    return parameter, unit, at_the_rig


def _reading(parameter: str, unit: str, number: str) -> Quantity:
    """A number in the unit of a level; NaN for a sensor with another unit or with an offset deviation."""
    name, _, level = _number(parameter, unit, lambda n: n[number])

    def at_the_rig(numbers: Mapping[str, float], plant: PlantDescription, at: str, scales: Scales) -> float:
        sensor = plant.sensor(at)
        plain = sensor.unit == "m" and sensor.gain == 1 and sensor.offset == 0
        return level(numbers, plant, at, scales) if plain else math.nan

    return name, unit, at_the_rig


def _dead_zone(numbers: Mapping[str, float], plant: PlantDescription, at: str, scales: Scales) -> float:
    return numbers["zone"] * scales.flow if plant.metered_flow(at).gain_unit == "1" else math.nan


def _leak(numbers: Mapping[str, float], plant: PlantDescription, at: str, scales: Scales) -> float:
    """Leak conductance as a share of the nominal capacity of the tank's reference pipe."""
    pipes = [p.name for p in plant.pipes]
    first = next((p.name for p in plant.pipes if at in (p.source, p.target)), pipes[0])
    reference = pipes.index(plant.tank(at).leak_reference or first)
    return numbers["conductance"] * scales.bore / float(conductance(plant)[reference])


# (effect, law of the hidden rig) -> the number of the law that is the same quantity as a parameter of the effect.
COMPARABLE: dict[tuple[str, str], Quantity] = {
    ("pump_gain", "scaled"): _number("factor", "1", lambda n: n["gain"]),
    ("pump_dead_zone", "threshold"): ("dead_zone", "m^3/s", _dead_zone),
    ("pump_saturation", "hard_limit"): _number("limit", "m^3/s", lambda n: n["limit"]),
    ("pump_lag", "slow"): _number("time_constant", "s", lambda n: n["tau"]),
    ("pump_delay", "late"): _number("delay", "s", lambda n: n["delay"]),
    ("flow_exponent", "other_power"): _number("excess", "1", lambda n: n["power"] - 0.5),
    ("outlet_drop", "down_pipe"): _number("drop", "m", lambda n: n["drop"]),
    ("coefficient_drift", "drifting_evenly"): _number("rate", "1/s", lambda n: n["change"] / n["span"]),
    ("plugging", "narrowed"): _number("size", "1", lambda n: n["loss"]),
    ("leak", "floor_hole"): ("size", "1", _leak),
    ("unmetered_flow", "tapped"): _number("flow", "m^3/s", lambda n: -n["draw"]),
    ("sensor_bias", "offset"): _reading("bias", "m", "offset"),
    ("sensor_gain", "stretched"): _number("factor", "1", lambda n: n["gain"]),
    ("sensor_lag", "damped"): _number("time_constant", "s", lambda n: n["tau"]),
    ("sensor_drift", "creeping"): _reading("rate", "m/s", "rate"),
    ("sensor_quantization", "rounded"): _reading("step", "m", "step"),
    ("sensor_delay", "late_reading"): _number("delay", "s", lambda n: n["delay"]),
    ("sensor_saturation", "clipped"): _reading("limit", "m", "ceiling"),
    ("sensor_saturation", "clipped_reading"): _reading("limit", "m", "ceiling"),
}


def size_errors(truth: Mapping[str, Any], causes: Iterable[Mapping[str, Any]], plant: PlantDescription) -> list[str]:
    """'effect z' for each correctly named cause that has a standard error and a true value of the same quantity."""
    units = truth.get("scales") or {}
    scales = Scales(units.get("time_s", 1.0), units.get("length_m", 1.0), units.get("area_m2", 1.0))
    true = {(c["effect"], c["location"]) for c in truth["causes"]}
    scores = []
    for cause in causes:
        for d in truth.get("deviations", ()):
            here, law = (d["effect"], d["location"]), (d["effect"], d["law"])
            if here not in true or here != (cause["effect"], cause["location"]) or law not in COMPARABLE:
                continue
            name, unit, value = COMPARABLE[law]
            amount = (cause.get("parameters") or {}).get(name) or {}
            expected = value(d["numbers"], plant, d["location"], scales)
            if amount.get("std") and math.isfinite(expected):
                factor = unit_factor(amount.get("unit") or "1", unit)
                scores.append(f"{d['effect']} {(factor * amount['value'] - expected) / (factor * amount['std']):.4g}")
    return scores


def sizes(rows: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """For each effect and all together: root mean square of z with its interval, share within 1.96 standard errors."""
    by: dict[str, list[float]] = {}
    for row in rows:
        for effect, z in (text.split() for text in row.get("z") or ()):
            for name in (effect, "all"):
                by.setdefault(name, []).append(float(z))
    return {name: _scores(by[name]) for name in [*sorted(by.keys() - {"all"}), *(["all"] if by else [])]}


def _scores(z: list[float]) -> dict[str, Any]:
    rms, *ends = root_mean_square_interval(z)
    within = share_of(sum(abs(v) <= NORMAL_95 for v in z), len(z))
    return {"rms": {"of": len(z), "mean": rms, "ci95": ends}, "within": within}
