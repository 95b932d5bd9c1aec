"""Simulation of cases and of their sensors' readings, with the equations of deviations that sit at sensors.

Such an equation, a law, maps a signal sampled at the times `time` (T,), s; each lane is a column. A sensor law acts on
the true level (T, n), m, before noise; a readout law acts on the noisy reading. Inputs switch at samples only, so that
a level is interpolated linearly between samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_torch.blind.conditions import HELD_OUT, RECORDED, Conditions
from fdi_torch.blind.deviation import Array, Deviation, Numbers
from fdi_torch.blind.plants import Rig
from fdi_torch.blind.simulator import HiddenRigs, SimulatedRun, grouped, simulate
from fdi_torch.plant.description import PlantDescription

PARTS = (("recording", RECORDED), ("holdout", HELD_OUT))
Deviations = tuple[Deviation, ...]
"""Differences of a rig from its plant file."""
Lane = tuple[Conditions, int, Deviations, bool]
"""One simulation: conditions, part (0 recording, 1 hold-out), deviations, whether random flows act."""


def simulated(lanes: Sequence[Lane], step: float) -> list[SimulatedRun]:
    """All simulations in one batch, with integration steps of `step` s."""
    rigs = HiddenRigs([c.built for c, *_ in lanes], [off for _, _, off, _ in lanes])
    return simulate(rigs, [c.drive(part, disturbed) for c, part, _, disturbed in lanes], step)


def noisy_readings(c: Conditions, run: SimulatedRun, part: int, deviations: Deviations) -> tuple[Array, Array]:
    """Readings with noise, and those without noise and readout effects, (T, S) m each."""
    clean = _measured_levels(c.rig, c.built, run.levels, deviations)
    return _with_laws(READOUT_LAWS, c.rig, clean + c.errors[part], deviations), clean


def _measured_levels(rig: Rig, built: PlantDescription, levels: Array, deviations: Sequence[Deviation]) -> Array:
    """(T, N) m -> (T, S) m: the level that follows from each reading with the sensor's nominal constants."""
    sensed = _with_laws(SENSOR_LAWS, rig, levels[:, rig.measured_tanks], deviations)
    pairs = list(zip(built.sensors, rig.plant.sensors, strict=True))
    gain = np.array([true.gain / nominal.gain for true, nominal in pairs])
    return sensed * gain + np.array([(true.offset - nominal.offset) / nominal.gain for true, nominal in pairs])


def _with_laws(laws: Any, rig: Rig, signal: Array, deviations: Sequence[Deviation]) -> Array:
    """The signal (T, S) after each active law of a group of laws, at its sensor."""
    time, result = np.arange(len(signal), dtype=np.float64), signal.copy()
    for group in grouped(laws, [[s.name for s in rig.plant.sensors]], [tuple(deviations)]):
        result[:, group.spot] = group.law(result[:, group.spot], time, group.numbers)
    return result


_SUBSTEPS = 20


def offset(x: Array, time: Array, p: Numbers) -> Array:
    return x + p["offset"]


def stretched(x: Array, time: Array, p: Numbers) -> Array:
    return p["gain"] * x


def creeping(x: Array, time: Array, p: Numbers) -> Array:
    """Drift at a constant rate."""
    return x + p["rate"] * time[:, None]


def late_reading(x: Array, time: Array, p: Numbers) -> Array:
    """Pure delay; before the start, the first level."""
    columns = [np.interp(time - d, time, column) for d, column in zip(p["delay"], x.T, strict=True)]
    return np.stack(columns, axis=1)


def damped(x: Array, time: Array, p: Numbers) -> Array:
    """First-order lag (stilling pipe), by backward Euler with twenty steps per sample."""
    return _chain(x, time, (p["tau"],))


def damped_twice(x: Array, time: Array, p: Numbers) -> Array:
    """Second-order lag (stilling pipe and filter): poles at 94 % and 6 % of the time constant."""
    return _chain(x, time, (0.94 * p["tau"], 0.06 * p["tau"]))


def _chain(x: Array, time: Array, taus: tuple[Array, ...]) -> Array:
    states, out = [x[0].copy() for _ in taus], np.empty_like(x)
    out[0] = x[0]
    for i in range(1, len(time)):
        shares = [(time[i] - time[i - 1]) / _SUBSTEPS / tau for tau in taus]
        for j in range(1, _SUBSTEPS + 1):
            drive = x[i - 1] + (x[i] - x[i - 1]) * (j / _SUBSTEPS)
            for k, a in enumerate(shares):
                states[k] = (states[k] + a * drive) / (1 + a)
                drive = states[k]
        out[i] = states[-1]
    return out


def clipped(x: Array, time: Array, p: Numbers) -> Array:
    return np.minimum(x, p["ceiling"])


def bowed(x: Array, time: Array, p: Numbers) -> Array:
    """Curvature: error `bow` halfway between two levels without error."""
    s = (x - p["low"]) / (p["high"] - p["low"])
    return x + p["bow"] * 4 * s * (1 - s)


def sticking_float(x: Array, time: Array, p: Numbers) -> Array:
    """Hysteresis of a float with friction: the play operator."""
    out = np.empty_like(x)
    held = x[0] - p["slack"]
    for i, level in enumerate(x):
        held = np.minimum(np.maximum(held, level - p["slack"]), level + p["slack"])
        out[i] = held
    return out


def humming(x: Array, time: Array, p: Numbers) -> Array:
    """Slow beat between a disturbance and the sampling."""
    return x + p["height"] * np.sin(2 * np.pi * time[:, None] / p["period"])


def freezing(x: Array, time: Array, p: Numbers) -> Array:
    """A transmitter that sometimes repeats its last value for a while."""
    phase = np.mod(time[:, None] / p["period"], 1.0)
    frozen = ((phase > 0.13) & (phase < 0.38)) | ((phase > 0.60) & (phase < 0.93))
    out = x.copy()
    for i in range(1, len(time)):
        out[i] = np.where(frozen[i], out[i - 1], x[i])
    return out


def jumped(x: Array, time: Array, p: Numbers) -> Array:
    """A zero shift at some time."""
    return x + p["offset"] * (time[:, None] > p["onset"])


def kinked(x: Array, time: Array, p: Numbers) -> Array:
    """A different gain above some level."""
    return x + p["extra"] * np.maximum(x - p["knee"], 0.0)


def leading(x: Array, time: Array, p: Numbers) -> Array:
    """Foam: positive error while the level rises, negative while it falls."""
    return x + p["ahead"] * np.gradient(x, time, axis=0)


def wandering(x: Array, time: Array, p: Numbers) -> Array:
    """Zero that varies with the temperature: two slow sines of incommensurate periods."""
    t = 2 * np.pi * time[:, None] / p["period"]
    return x + 0.5 * p["height"] * (np.sin(t) + np.sin(t / 0.618 + 1.0))


def rounded(x: Array, time: Array, p: Numbers) -> Array:
    return p["step"] * np.round(x / p["step"])


def bursting(x: Array, time: Array, p: Numbers) -> Array:
    """Short bursts of outliers: each starts with this probability, lasts up to four samples, and has one height."""
    out = x.copy()
    for column, (seed, chance, height) in enumerate(zip(p["seed"], p["chance"], p["height"], strict=True)):
        rng = np.random.default_rng(int(seed))
        for start in np.flatnonzero(rng.random(len(x)) < chance):
            out[start : start + rng.integers(1, 5), column] += height * rng.choice((-1, 1)) * (0.5 + rng.exponential())
    return out


SENSOR_LAWS = {law.__name__: law for law in (
    late_reading, damped, damped_twice, bowed, sticking_float, leading, kinked, stretched, offset, jumped, wandering,
    creeping, humming, freezing, clipped,
)} | {"clipped_reading": clipped}  # fmt: skip
# A transmitter's own limit clips the noise with the level: it acts twice, on either side of the noise.
READOUT_LAWS = {"bursting": bursting, "clipped_reading": clipped, "rounded": rounded}
