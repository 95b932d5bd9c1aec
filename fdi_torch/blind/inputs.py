"""Inputs of the hidden rigs: a signal for each channel, held for whole seconds, rounded as in the recording; or the
commands of a controller, by which one pump keeps one level near a set point that changes in random steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle, repeat

import numpy as np

from fdi_torch.blind.deviation import Array
from fdi_torch.blind.plants import Rig
from fdi_torch.plant.description import PlantDescription, Pump

SHORTEST_HOLD, LONGEST_HOLD = 40, 220  # s
# Unit of a command in the recording's header -> its printed decimals, and its SI value.
DECIMALS = {"cm3_s": 1, "V": 3, "1": 4}
FACTORS = {"cm3_s": 1e-6, "V": 1.0, "1": 1.0}


def command_unit(pump: Pump) -> str:
    """Unit of a pump's command in the recording's header."""
    return "cm3_s" if pump.gain_unit == "1" else "V" if pump.gain_unit.endswith("/V") else "1"


def pumps_of_channels(plant: PlantDescription) -> list[Pump]:
    """The first pump of each input channel."""
    return [next(p for p in plant.pumps if p.channel == channel) for channel in plant.channels()]


def channel_limits(rig: Rig) -> Array:
    """(C, 2): lowest and highest command of each channel, in the header's unit."""
    rows = []
    for pump in pumps_of_channels(rig.plant):
        full = pump.max_flow / pump.gain / FACTORS[command_unit(pump)]
        rows.append((rig.input_low * full, rig.input_high * full))
    return np.array(rows)


def as_printed(rig: Rig, commands: Array) -> Array:
    """Commands rounded as the recording prints them, so that the rig gets the recorded values."""
    decimals = [DECIMALS[command_unit(pump)] for pump in pumps_of_channels(rig.plant)]
    return np.stack([np.round(commands[:, i], d) for i, d in enumerate(decimals)], axis=1)


# A signal is f(rng, samples) -> (samples,): shares of the way from the lowest to the highest command. Rich ones:


def steps(rng: np.random.Generator, samples: int) -> Array:
    """Random steps of random duration."""
    return _held(rng, samples, (float(rng.random()) for _ in repeat(None)))


def ramps(rng: np.random.Generator, samples: int) -> Array:
    """Straight lines between random values."""
    whiles = rng.integers(SHORTEST_HOLD, LONGEST_HOLD, size=samples // SHORTEST_HOLD + 1)
    at = np.concatenate(([0], np.cumsum(whiles)))
    return np.interp(np.arange(samples), at, rng.random(len(at)))


def waves(rng: np.random.Generator, samples: int) -> Array:
    """Sum of four sines with periods from twice the shortest to four times the longest step duration."""
    periods = np.geomspace(2 * SHORTEST_HOLD, 4 * LONGEST_HOLD, 4) * rng.uniform(0.8, 1.25, size=4)
    sines = np.sin(2 * np.pi * (np.arange(samples)[:, None] / periods + rng.random(4))).sum(axis=1)
    return (sines - sines.min()) / np.ptp(sines)


# Poor ones:


def two_steps(rng: np.random.Generator, samples: int) -> Array:
    """One step up (or down) after a third, and back after two thirds."""
    middle, up = rng.uniform(0.25, 0.55), rng.uniform(0.25, 0.75)
    return np.where(np.arange(samples) // (samples // 3) == 1, up, middle)


def two_levels(rng: np.random.Generator, samples: int) -> Array:
    """Alternating low and high values of random duration."""
    return _held(rng, samples, cycle((rng.uniform(0.0, 0.35), rng.uniform(0.65, 1.0))))


def one_step(rng: np.random.Generator, samples: int) -> Array:
    """One step up or down in the middle third."""
    first, second = rng.permutation([rng.uniform(0.15, 0.4), rng.uniform(0.6, 0.85)])
    return np.where(np.arange(samples) < rng.uniform(0.33, 0.67) * samples, first, second)


def one_hill(rng: np.random.Generator, samples: int) -> Array:
    """A slow ramp up and down."""
    top, foot = rng.uniform(0.3, 0.7) * samples, rng.uniform(0.1, 0.3)
    return np.interp(np.arange(samples), [0, top, samples], [foot, rng.uniform(0.7, 0.95), foot])


def _held(rng: np.random.Generator, samples: int, values: Iterator[float]) -> Array:
    out, at = np.empty(samples), 0
    while at < samples:
        hold = int(rng.integers(SHORTEST_HOLD, LONGEST_HOLD))
        out[at : at + hold] = next(values)
        at += hold
    return out


Signal = Callable[[np.random.Generator, int], Array]
SIGNALS: dict[str, dict[Signal, float]] = {
    "rich": {steps: 0.7, ramps: 0.15, waves: 0.15},
    "steps": {steps: 1.0},
    "poor": {two_steps: 0.6, one_step: 0.12, one_hill: 0.12, two_levels: 0.16},
}
"""Signals and their frequencies."""


def drawn(rng: np.random.Generator, inputs: str) -> Signal:
    signals = list(SIGNALS[inputs])
    return signals[int(rng.choice(len(signals), p=list(SIGNALS[inputs].values())))]


def commanded(rig: Rig, rng: np.random.Generator, samples: int, signal: Signal = steps) -> Array:
    """The commands (T, C) in the header's unit: one random signal of the given kind for each channel."""
    limits = channel_limits(rig)
    shares = np.stack([signal(rng, samples) for _ in limits], axis=1)
    return as_printed(rig, limits[:, 0] + (limits[:, 1] - limits[:, 0]) * shares)


def with_standstills(rig: Rig, rng: np.random.Generator, samples: int, resting: str) -> Array:
    """Random steps; one channel is often at rest for long, so that steps of the others reverse flows."""
    commands, column, at = commanded(rig, rng, samples), rig.plant.channels().index(resting), 0
    while at < samples:
        at += int(rng.integers(2 * SHORTEST_HOLD, 2 * LONGEST_HOLD))
        still = int(rng.integers(2 * LONGEST_HOLD, 4 * LONGEST_HOLD))
        commands[at : at + still, column] = 0.0
        at += still
    return commands


def channel_to_rest(plant: PlantDescription, pipe: str) -> str:
    """The channel whose rest reverses the flow of a pipe: it feeds the pipe's source, or at least not its target."""
    p = plant.pipe(pipe)
    feeding = [q.channel for q in plant.pumps if q.target == p.source]
    others = [q.channel for q in plant.pumps if q.target != p.target]
    return (*feeding, *others, plant.channels()[0])[0]


LAWS = ("two_point", "proportional_integral")
SHORTEST_SETTING, LONGEST_SETTING = 200, 500  # s for which a set point is held
BAND = 0.01  # of the two-point law, as a share of the tank's height
INTERVAL, RESET = 5, 120.0  # s; sampling interval and reset time of the proportional-integral law


@dataclass(frozen=True)
class LevelControl:
    """Level control by one pump.

    law 'two_point': high or low flow, switched `band` m from the set point, every second. law 'proportional_integral':
    q = middle + gain (e + integral of e / reset) every `INTERVAL` s, with the integral frozen while the pump is at a
    limit. pump, tank: indices in the rig. set_points (T,) m. low, high: limits of the flow, m^3/s. gain: m^2/s.
    quantum: resolution of commands, m^3/s.
    """

    law: str
    pump: int
    tank: int
    set_points: Array
    low: float
    high: float
    band: float
    gain: float
    quantum: float


class Controller:
    """State of a level control: its output depends on its previous output."""

    def __init__(self, control: LevelControl) -> None:
        self.control, self.pump, self.tank = control, control.pump, control.tank
        self.asked, self.integral = 0.5 * (control.low + control.high), 0.0

    def flow(self, second: int, reading: float) -> float:
        """Requested flow in the next second, m^3/s. reading: m."""
        c = self.control
        error = float(c.set_points[min(second, len(c.set_points) - 1)]) - reading
        if c.law == "two_point":
            self.asked = c.high if error > c.band else c.low if error < -c.band else self.asked
        elif second % INTERVAL == 0:
            integral = self.integral + error * INTERVAL / RESET
            wanted = 0.5 * (c.low + c.high) + c.gain * (error + integral)
            self.asked = min(max(wanted, c.low), c.high)
            self.integral = integral if wanted == self.asked else self.integral
        return round(self.asked / c.quantum) * c.quantum


def draw_control(
    rng: np.random.Generator, plant: PlantDescription, levels: Sequence[Array], limits: Array, quantum: Array
) -> tuple[LevelControl, ...]:
    """The control of one level, for recordings with the lengths of `levels` ((T, N) m, undisturbed, open loop).

    limits (M, 2): lowest and highest flow of each pump, quantum (M,): its smallest change, m^3/s. Set points lie
    between the quantiles of 20 and 80 % of the levels in open loop, so that the pump can hold them.
    Raises ValueError where no pump feeds a measured tank.
    """
    tanks, measured = [t.name for t in plant.tanks], {s.tank for s in plant.sensors}
    possible = [i for i, pump in enumerate(plant.pumps) if pump.target in measured]
    if not possible:
        raise ValueError(f"{plant.title}: expected a pump into a measured tank, got none; add a sensor there")
    pump = int(rng.choice(possible))
    tank, law = tanks.index(plant.pumps[pump].target), str(rng.choice(LAWS))
    height, (low, high) = plant.tanks[tank].height, limits[pump]
    gain = float(rng.uniform(1.0, 4.0)) * (high - low) / (0.1 * height)

    def control(reached: Array) -> LevelControl:
        settings, at = np.empty(len(reached)), 0
        while at < len(reached):
            hold = int(rng.integers(SHORTEST_SETTING, LONGEST_SETTING))
            settings[at : at + hold] = np.quantile(reached[:, tank], rng.uniform(0.2, 0.8))
            at += hold
        return LevelControl(law, pump, tank, settings, low, high, BAND * height, gain, float(quantum[pump]))

    return tuple(control(reached) for reached in levels)
