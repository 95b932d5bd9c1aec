"""Readings of the sensors of cases, with the equations of deviations that sit at sensors.

Such an equation, a law, maps a signal sampled at the times `time` (T,), s; each lane is a column. A sensor law acts on
the true level (T, n), m, before noise; a readout law acts on the noisy reading. Inputs switch at samples only, so that
a level is interpolated linearly between samples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from fdi_torch.blind.conditions import HELD_OUT, RECORDED, Conditions, Deviations
from fdi_torch.blind.deviation import Array, Deviation, Numbers
from fdi_torch.blind.plants import Rig
from fdi_torch.blind.simulator import SimulatedRun, grouped
from fdi_torch.plant.description import PlantDescription

PARTS = (("recording", RECORDED), ("holdout", HELD_OUT))


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


def _with_laws(laws: Mapping[str, Law], rig: Rig, signal: Array, deviations: Sequence[Deviation]) -> Array:
    """The signal (T, S) after each active law of a group of laws, at its sensor."""
    time, result = np.arange(len(signal), dtype=np.float64), signal.copy()
    for group in grouped(laws, [[s.name for s in rig.plant.sensors]], [tuple(deviations)]):
        result[:, group.spot] = group.law(result[:, group.spot], time, group.numbers)
    return result


Law = Callable[[Array, Array, Numbers], Array]
_SUBSTEPS = 20


def late_reading(x: Array, time: Array, p: Numbers) -> Array:
    """Pure delay; before the start, the first level."""
    columns = [np.interp(time - d, time, column) for d, column in zip(p["delay"], x.T, strict=True)]
    return np.stack(columns, axis=1)


def _chain(x: Array, time: Array, taus: tuple[Array, ...]) -> Array:
    """First-order lags in series, by backward Euler with twenty steps per sample."""
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


def freezing(x: Array, time: Array, p: Numbers) -> Array:
    """A transmitter that sometimes repeats its last value for a while."""
    phase = np.mod(time[:, None] / p["period"], 1.0)
    frozen = ((phase > 0.13) & (phase < 0.38)) | ((phase > 0.60) & (phase < 0.93))
    out = x.copy()
    for i in range(1, len(time)):
        out[i] = np.where(frozen[i], out[i - 1], x[i])
    return out


def wandering(x: Array, time: Array, p: Numbers) -> Array:
    """Zero that varies with the temperature: two slow sines of incommensurate periods."""
    t = 2 * np.pi * time[:, None] / p["period"]
    return x + 0.5 * p["height"] * (np.sin(t) + np.sin(t / 0.618 + 1.0))


def bursting(x: Array, time: Array, p: Numbers) -> Array:
    """Short bursts of outliers: each starts with this probability, lasts up to four samples, and has one height."""
    out = x.copy()
    for column, (seed, chance, height) in enumerate(zip(p["seed"], p["chance"], p["height"], strict=True)):
        rng = np.random.default_rng(int(seed))
        for start in np.flatnonzero(rng.random(len(x)) < chance):
            out[start : start + rng.integers(1, 5), column] += height * rng.choice((-1, 1)) * (0.5 + rng.exponential())
    return out


SENSOR_LAWS: dict[str, Law] = {  # in the order in which they act
    "late_reading": late_reading,
    # Stilling pipe: first-order lag; with a filter: poles at 94 % and 6 % of the time constant.
    "damped": lambda x, time, p: _chain(x, time, (p["tau"],)),
    "damped_twice": lambda x, time, p: _chain(x, time, (0.94 * p["tau"], 0.06 * p["tau"])),
    "bowed": bowed,
    "sticking_float": sticking_float,
    # Foam: positive error while the level rises, negative while it falls.
    "leading": lambda x, time, p: x + p["ahead"] * np.gradient(x, time, axis=0),
    # A different gain above some level.
    "kinked": lambda x, time, p: x + p["extra"] * np.maximum(x - p["knee"], 0.0),
    "stretched": lambda x, time, p: p["gain"] * x,
    "offset": lambda x, time, p: x + p["offset"],
    # A zero shift at some time.
    "jumped": lambda x, time, p: x + p["offset"] * (time[:, None] > p["onset"]),
    "wandering": wandering,
    "creeping": lambda x, time, p: x + p["rate"] * time[:, None],
    # Slow beat between a disturbance and the sampling.
    "humming": lambda x, time, p: x + p["height"] * np.sin(2 * np.pi * time[:, None] / p["period"]),
    "freezing": freezing,
    "clipped": lambda x, time, p: np.minimum(x, p["ceiling"]),
    "clipped_reading": lambda x, time, p: np.minimum(x, p["ceiling"]),
}
# A transmitter's own limit clips the noise with the level: it acts twice, on either side of the noise.
READOUT_LAWS: dict[str, Law] = {
    "bursting": bursting,
    "clipped_reading": SENSOR_LAWS["clipped_reading"],
    "rounded": lambda x, time, p: p["step"] * np.round(x / p["step"]),
}
