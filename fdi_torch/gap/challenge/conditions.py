"""Under which conditions a case is recorded: inputs, start levels, calibration constants, noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fdi_torch.gap.challenge.built import as_built
from fdi_torch.gap.challenge.colours import WHITE, Colour, draw_colour
from fdi_torch.gap.challenge.inputs import (
    FACTORS,
    channel_limits,
    command_unit,
    commanded,
    drawn,
    in_print,
    with_standstills,
)
from fdi_torch.gap.challenge.moment import Array
from fdi_torch.gap.challenge.plants import Rig
from fdi_torch.gap.challenge.simulator import HiddenRigs, simulate
from fdi_torch.plant.description import PlantDescription

RECORDED, HELD_OUT = 3601, 2401
_COARSE = 0.25


@dataclass(frozen=True)
class Conditions:
    """commands: recording and hold-out, (T, C) in the header's unit. signal: of the recording, by name.

    starts (2, N) m. built: the rig's true constants. noise (S,): standard deviation of each sensor's readings, m.
    """

    commands: tuple[Array, Array]
    signal: str
    starts: Array
    built: PlantDescription
    noise: Array
    colour: Colour


def draw_conditions(
    rig: Rig, rng: np.random.Generator, inputs: str, coloured: float, rest: Array, resting: str | None = None
) -> Conditions:
    """inputs: 'rich' or 'poor' (in the recording). coloured: chance of coloured noise.

    rest (N,): the sound rig's levels at middling inputs, m. resting: a channel that often stands still.
    """
    plant = rig.plant
    if resting:
        name, commands = "with_standstills", [with_standstills(rig, rng, n, resting) for n in (RECORDED, HELD_OUT)]
    else:
        signal = drawn(rng, inputs)
        name, commands = signal.__name__, [commanded(rig, rng, RECORDED, signal), commanded(rig, rng, HELD_OUT)]
    heights = np.array([t.height for t in plant.tanks])
    starts = np.minimum(rest * rng.uniform(0.75, 1.25, size=(2, len(rest))), 0.85 * heights)
    built = as_built(plant, rng)
    noise = float(rng.choice([0.05, 0.1, 0.2])) * rig.noise_unit * rng.uniform(0.7, 1.4, size=len(plant.sensors))
    colour = draw_colour(rng) if rng.random() < coloured else WHITE
    return Conditions((commands[0], commands[1]), name, starts, built, noise, colour)


def asked_of_pumps(plant: PlantDescription, commands: Array) -> Array:
    """(T, C) in the header's unit -> (T, M) m^3/s, within each pump's range."""
    channels = plant.channels()
    flows = [p.gain * FACTORS[command_unit(p)] * commands[:, channels.index(p.channel)] for p in plant.pumps]
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
