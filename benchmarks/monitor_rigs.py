"""Recordings of the three tanks with a fault and random flows, by the equations of the blind benchmark.

T1 is under proportional-integral control by Q1, or open loop; Q2 moves in steps. The random flows are white, held for
15 s, or slow (Ornstein-Uhlenbeck, 150 s). Faults are abrupt, or grow linearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.signal import lfilter

from fdi_torch.blind.deviation import Array
from fdi_torch.blind.inputs import Controller, LevelControl
from fdi_torch.blind.random_flows import Disturbance
from fdi_torch.blind.simulator import Drive, Group, HiddenRigs, simulate
from fdi_torch.config.plant_file import load_plant
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

STEP, NOISE, GROWTH = 0.05, 1e-3, 1500.0
KINDS = {"white": 1.0, "held": 15.0, "slow": 150.0}
FLOW = 1.5e-6
"""Standard deviation of the random flow into a tank, m^3/s, held for 15 s; that of the others has the same effect on a
level after a minute."""
REST = np.array([0.59, 0.393, 0.492])
"""Steady levels with 50 cm^3/s from each pump, m."""
SIZES = {
    "T1.leak.size": 0.15, "T2.leak.size": 0.15, "T3.leak.size": 0.15,
    "P13.plugging.size": 0.2, "P32.plugging.size": 0.2, "OUT2.plugging.size": 0.2,
    "Q1.pump_gain.factor": -0.12, "Q2.pump_gain.factor": -0.12,
    "h1.sensor_bias.bias": 0.03, "h2.sensor_bias.bias": 0.03, "h3.sensor_bias.bias": 0.03,
    "h1.sensor_bias.bias down": -0.03, "h2.sensor_bias.bias down": -0.03, "h3.sensor_bias.bias down": -0.03,
    "Q1.pump_offset.offset": -6e-6, "Q2.pump_offset.offset": -6e-6,
    "h1.sensor_gain.factor": 0.07, "h2.sensor_gain.factor": 0.07, "h3.sensor_gain.factor": 0.07,
    "h1.sensor_gain.factor down": -0.07, "h2.sensor_gain.factor down": -0.07, "h3.sensor_gain.factor down": -0.07,
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One recording. fault: a key of SIZES, empty for none. ramp: duration of its growth, s; 0 if abrupt. learn: s.

    share: of the usual size. pumps: flows asked for after the learning part, m^3/s, instead of the usual commands.
    correlation: of neighbouring values of the sensors' noise. tolerance: standard deviation of the rig's discharge
    coefficients about the plant's, in its tolerances. rests: whether the commands and set points rest at the usual mean
    during the learning part, from the plant's steady levels on. flows: share of the usual random flows.
    """

    fault: str
    ramp: float
    kind: str
    learn: float
    onset: float
    lasts: float
    closed: bool
    seed: int
    share: float = 1.0
    pumps: tuple[float, float] | None = None
    correlation: float = 0.0
    tolerance: float = 0.0
    rests: bool = False
    flows: float = 1.0

    @property
    def name(self) -> str:
        return self.fault.partition(" ")[0]

    @property
    def size(self) -> float:
        return SIZES[self.fault] * self.share if self.fault else 0.0

    def size_at(self, time: float) -> float:
        """Value of the faulty parameter at a time (s), in SI: a factor differs from 1 by the size."""
        return self.name.endswith(".factor") + self.size * float(_grown(time, self.onset, self.ramp))


def recordings(cases: Sequence[Case], step: float = STEP) -> list[tuple[Recording, Array]]:
    """Recording and true levels (T, N) m of each case, all simulated together."""
    plant, draws = load_plant("three_tank"), [np.random.default_rng(case.seed) for case in cases]
    rigs = HiddenRigs([_rig(plant, case) for case in cases], [()] * len(cases))
    _with_faults(rigs, plant, cases)
    sensors, drives = [], []
    for case, rng in zip(cases, draws, strict=True):
        samples = int(case.lasts) + 1
        shocks = (1.0 - case.correlation**2) ** 0.5 * rng.normal(size=(samples, 3))
        noise = NOISE * lfilter([1.0], [1.0, -case.correlation], shocks, axis=0)
        error = noise + _sensor_fault(case, "sensor_bias", samples)
        sensors.append((1.0 + _sensor_fault(case, "sensor_gain", samples), error))
        drives.append(_drive(case, rng, samples, *sensors[-1]))
    runs = simulate(rigs, drives, step)
    return [
        (_recording(run.asked, factor * (run.levels + error)), run.levels)
        for run, (factor, error) in zip(runs, sensors, strict=True)
    ]


def _rig(plant: PlantDescription, case: Case) -> PlantDescription:
    """The plant with discharge coefficients that differ from those of its file."""
    rng = np.random.default_rng([case.seed, 1])  # apart from that of flows and noise
    std = {p.name: case.tolerance * plant.tolerances[f"{p.name}.discharge_coefficient"] for p in plant.pipes}
    factors = [float(np.exp(std[p.name] * rng.normal())) for p in plant.pipes]
    pipes = (
        replace(p, discharge_coefficient=p.discharge_coefficient * factor)
        for p, factor in zip(plant.pipes, factors, strict=True)
    )
    return replace(plant, pipes=tuple(pipes))


def _recording(asked: Array, readings: Array) -> Recording:
    time = torch.arange(len(asked), dtype=torch.float64)
    units = ("m^3/s", "m^3/s"), ("m", "m", "m")
    return Recording(
        time, torch.from_numpy(asked.copy()), torch.from_numpy(readings), ("Q1", "Q2"), ("h1", "h2", "h3"), *units
    )


@dataclass(frozen=True)
class _ScaledControl(LevelControl):
    """Level control with a reading that is multiplied by `factor` (T,)."""

    factor: Array

    def start(self) -> Controller:
        return _ScaledController(self)


class _ScaledController(Controller):
    control: _ScaledControl

    def flow(self, second: int, reading: float) -> float:
        factor = self.control.factor
        return super().flow(second, float(factor[min(second, len(factor) - 1)]) * reading)  # others may last longer


def _drive(case: Case, rng: np.random.Generator, samples: int, factor: Array, error: Array) -> Drive:
    """Commands between 40 and 60 cm^3/s in steps of 200 to 500 s, set points of T1 between 52 and 60 cm.

    factor, error (T, 3): a sensor reads factor (level + error).
    """
    asked, points = np.empty((samples, 2)), np.empty(samples)
    for column in (asked[:, 0], asked[:, 1], points):
        first = 0
        while first < samples:
            hold = int(rng.integers(200, 500))
            column[first : first + hold] = rng.uniform()
            first += hold
    asked, points = 1e-6 * (40.0 + 20.0 * asked), 0.52 + 0.08 * points
    if case.pumps is not None:
        asked[int(case.learn) :] = case.pumps
    start = np.array([0.52, 0.32, 0.42])
    if case.rests:
        start = REST
        asked[: int(case.learn)], points[: int(case.learn)] = 5e-5, REST[0]
    # The variance of the flow integrated over a minute is that of flows held for 15 s.
    scale = {"white": 15.0**0.5, "held": 1.0, "slow": 0.55}[case.kind]
    random = Disturbance(case.kind, KINDS[case.kind], case.flows * FLOW * scale * rng.uniform(0.5, 1.5, size=3), 1.0)
    limits = "proportional_integral", 0, 0, points, 0.0, 9e-5, 0.01, 1e-3, 1e-8
    control = _ScaledControl(*limits, factor[:, 0]) if case.closed else None
    return Drive(asked, start, random.values(rng, samples), control, error[:, 0])


def _sensor_fault(case: Case, kind: str, samples: int) -> Array:
    """Size of a fault of this kind at each sensor (T, 3)."""
    size, time = np.zeros((samples, 3)), np.arange(samples)
    if kind in case.fault:
        size[:, int(case.fault[1]) - 1] = case.size * _grown(time, case.onset, case.ramp)
    return size


def _grown(time: Array | float, onset: Array | float, ramp: Array | float) -> Array:
    """Share of a fault's final size at a time."""
    return np.clip((time - onset) / np.maximum(ramp, 1e-9), 0.0, 1.0)


def _with_faults(rigs: HiddenRigs, plant: PlantDescription, cases: Sequence[Case]) -> None:
    """Add the faulty components' laws to the simulated rigs."""
    root = np.sqrt(2.0 * plant.gravity)
    conductance = {p.name: p.discharge_coefficient * p.area * root for p in plant.pipes}
    pipe_of = {"T1": "P13", "T2": "OUT2", "T3": "P32"}
    places = {
        "leak": ([t.name for t in plant.tanks], rigs.tank_groups),
        "plugging": ([p.name for p in plant.pipes], rigs.pipe_groups),
        "pump_gain": ([p.name for p in plant.pumps], rigs.pump_groups),
        "pump_offset": ([p.name for p in plant.pumps], rigs.pump_groups),
    }
    for kind, (names, groups) in places.items():
        chosen = [(i, c) for i, c in enumerate(cases) if f".{kind}." in c.fault]
        if not chosen:
            continue
        spot = np.array([i * len(names) + names.index(c.fault.partition(".")[0]) for i, c in chosen], dtype=np.intp)
        size = [c.size * (conductance[pipe_of[c.fault[:2]]] if kind == "leak" else 1.0) for _, c in chosen]
        numbers = {"onset": [c.onset for _, c in chosen], "ramp": [c.ramp for _, c in chosen], "size": size}
        outside = np.full(len(chosen), rigs.count, dtype=np.intp)
        groups.append(Group(_LAWS[kind], spot, outside, {k: np.array(v) for k, v in numbers.items()}))


def _leak(level, other, now, p, state):  # type: ignore[no-untyped-def]
    return p["size"] * _grown(now.time, p["onset"], p["ramp"]) * np.sqrt(np.maximum(level, 0.0)), None


def _plugging(head, q, now, p, state):  # type: ignore[no-untyped-def]
    return 1.0 - p["size"] * _grown(now.time, p["onset"], p["ramp"]), None


def _pump_gain(q, now, p, state):  # type: ignore[no-untyped-def]
    return q * (1.0 + p["size"] * _grown(now.time, p["onset"], p["ramp"])), None


def _pump_offset(q, now, p, state):  # type: ignore[no-untyped-def]
    return np.maximum(q + p["size"] * _grown(now.time, p["onset"], p["ramp"]), 0.0), None


_LAWS = {"leak": _leak, "plugging": _plugging, "pump_gain": _pump_gain, "pump_offset": _pump_offset}
