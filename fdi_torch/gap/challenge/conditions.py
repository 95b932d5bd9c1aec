"""Under which conditions a case is recorded: inputs, start levels, calibration constants, noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fdi_torch.gap.challenge.built import as_built
from fdi_torch.gap.challenge.moment import Array
from fdi_torch.gap.challenge.plants import Rig
from fdi_torch.gap.challenge.simulator import HiddenRigs, simulate
from fdi_torch.plant.description import PlantDescription, Pump

RECORDED, HELD_OUT = 3601, 2401
SHORTEST_HOLD, LONGEST_HOLD = 40, 220
_DECIMALS = {"cm3_s": 1, "V": 3, "1": 4}
_FACTORS = {"cm3_s": 1e-6, "V": 1.0, "1": 1.0}
_COARSE = 0.25


@dataclass(frozen=True)
class Conditions:
    """commands: recording and hold-out, (T, C) in the header's unit. starts (2, N) m. built: the rig's true constants.

    noise: standard deviation of a reading, m. colour: AR(1) coefficient from sample to sample.
    """

    commands: tuple[Array, Array]
    starts: Array
    built: PlantDescription
    noise: float
    colour: float


def command_unit(pump: Pump) -> str:
    """The unit that stands in the header of a pump's command."""
    return "cm3_s" if pump.gain_unit == "1" else "V" if pump.gain_unit.endswith("/V") else "1"


def draw_conditions(
    rig: Rig, rng: np.random.Generator, inputs: str, coloured: float, rest: Array, resting: str | None = None
) -> Conditions:
    """inputs: 'steps' (random steps) or 'poor' (two steps in the recording). coloured: chance of AR(1) noise.

    rest (N,): the sound rig's levels at middling inputs, m. resting: a channel that often stands still.
    """
    plant = rig.plant
    recorded = two_steps(rig, rng) if inputs == "poor" else random_steps(rig, rng, RECORDED, resting)
    held_out = random_steps(rig, rng, HELD_OUT, resting)
    heights = np.array([t.height for t in plant.tanks])
    starts = np.minimum(rest * rng.uniform(0.75, 1.25, size=(2, len(rest))), 0.85 * heights)
    built = as_built(plant, rng)
    noise = float(rng.choice([0.05, 0.1, 0.2])) * rig.noise_unit
    colour = float(rng.uniform(0.6, 0.9)) if rng.random() < coloured else 0.0
    return Conditions((recorded, held_out), starts, built, noise, colour)


def channel_limits(rig: Rig) -> Array:
    """(C, 2): lowest and highest command of each channel, in the header's unit."""
    rows = []
    for channel in rig.plant.channels():
        pump = next(p for p in rig.plant.pumps if p.channel == channel)
        full = pump.max_flow / pump.gain / _FACTORS[command_unit(pump)]
        rows.append((rig.input_low * full, rig.input_high * full))
    return np.array(rows)


def random_steps(rig: Rig, rng: np.random.Generator, samples: int, resting: str | None = None) -> Array:
    """Each channel takes a random value for a random while.

    Where one is to rest, two in five of its whiles are long standstills, in which the others' steps turn flows round.
    """
    out = np.empty((samples, len(rig.plant.channels())))
    for column, (channel, (low, high)) in enumerate(zip(rig.plant.channels(), channel_limits(rig), strict=True)):
        at = 0
        while at < samples:
            hold, value = int(rng.integers(SHORTEST_HOLD, LONGEST_HOLD)), rng.uniform(low, high)
            if channel == resting and rng.random() < 0.4:
                hold, value = int(rng.integers(2 * LONGEST_HOLD, 4 * LONGEST_HOLD)), 0.0
            out[at : at + hold, column] = value
            at += hold
    return in_print(rig, out)


def channel_to_rest(plant: PlantDescription, pipe: str) -> str:
    """The channel whose rest turns the flow of a pipe round: it feeds its source, or at least not its target."""
    p = next(p for p in plant.pipes if p.name == pipe)
    feeding = [q.channel for q in plant.pumps if q.target == p.source]
    others = [q.channel for q in plant.pumps if q.target != p.target]
    return (*feeding, *others, plant.channels()[0])[0]


def two_steps(rig: Rig, rng: np.random.Generator) -> Array:
    """Poor excitation: up (or down) after a third, and back after two."""
    limits = channel_limits(rig)
    width = limits[:, 1] - limits[:, 0]
    middle, up = (limits[:, 0] + width * rng.uniform(a, b, size=len(width)) for a, b in ((0.25, 0.55), (0.25, 0.75)))
    out = np.tile(middle, (RECORDED, 1))
    out[RECORDED // 3 : 2 * RECORDED // 3] = up
    return in_print(rig, out)


def in_print(rig: Rig, commands: Array) -> Array:
    """Rounded as the recording will print it, so that the rig gets what the recording says."""
    units = [command_unit(next(p for p in rig.plant.pumps if p.channel == c)) for c in rig.plant.channels()]
    return np.stack([np.round(commands[:, i], _DECIMALS[u]) for i, u in enumerate(units)], axis=1)


def asked_of_pumps(plant: PlantDescription, commands: Array) -> Array:
    """(T, C) in the header's unit -> (T, M) m^3/s, within each pump's range."""
    channels = plant.channels()
    flows = [p.gain * _FACTORS[command_unit(p)] * commands[:, channels.index(p.channel)] for p in plant.pumps]
    return np.stack([np.clip(q, 0.0, p.max_flow) for p, q in zip(plant.pumps, flows, strict=True)], axis=1)


def levels_at_rest(rig: Rig) -> Array:
    """(N,) m: where the sound rig comes to rest at middling inputs."""
    middle = in_print(rig, np.tile(channel_limits(rig).mean(axis=1), (4001, 1)))
    asked = asked_of_pumps(rig.plant, middle)[..., None]
    start = np.array([[0.4 * t.height] for t in rig.plant.tanks])
    return simulate(HiddenRigs([rig.plant], [()]), asked, start, _COARSE)[-1, :, 0]


def sound_levels(rig: Rig, all_conditions: list[Conditions], part: int) -> Array:
    """(T, N, L) m: each recording (0) or hold-out (1) as the rig without any effect would run, coarsely."""
    asked = np.stack([asked_of_pumps(c.built, c.commands[part]) for c in all_conditions], axis=-1)
    start = np.stack([c.starts[part] for c in all_conditions], axis=-1)
    rigs = HiddenRigs([c.built for c in all_conditions], [()] * len(all_conditions))
    return simulate(rigs, asked, start, _COARSE)


def kept_below_the_rim(rig: Rig, all_conditions: list[Conditions]) -> tuple[list[Conditions], Array]:
    """Turns the inputs of those down whose sound rig comes near its rim; with the sound levels (T, N, L) recorded.

    Raises ValueError where that does not help.
    """
    rim = np.array([0.85 * t.height for t in rig.plant.tanks])[:, None]
    kept = list(all_conditions)
    recorded, held_out = (sound_levels(rig, kept, part) for part in (0, 1))
    for _ in range(6):
        high = np.flatnonzero((np.maximum(recorded.max(axis=0), held_out.max(axis=0)) > rim).any(axis=0))
        if not len(high):
            return kept, recorded
        for lane in high:
            first, second = (in_print(rig, 0.85 * c) for c in kept[lane].commands)
            kept[lane] = replace(kept[lane], commands=(first, second))
        turned_down = [kept[lane] for lane in high]
        recorded[:, :, high], held_out[:, :, high] = (sound_levels(rig, turned_down, part) for part in (0, 1))
    raise ValueError(
        f"rig {rig.plant.name}: expected inputs that keep it below its rim, got overflow; lower input_high"
    )
