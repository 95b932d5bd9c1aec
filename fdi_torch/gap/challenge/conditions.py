"""Under which conditions a case is recorded: inputs, start levels, calibration constants, noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

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
    """commands: recording and hold-out, (T, C) in the header's unit. starts (2, N) m. conductance (P,) m^2.5/s.

    noise: standard deviation of a reading, m. colour: AR(1) coefficient from sample to sample.
    """

    commands: tuple[Array, Array]
    starts: Array
    conductance: Array
    noise: float
    colour: float


def command_unit(pump: Pump) -> str:
    """The unit that stands in the header of a pump's command."""
    return "cm3_s" if pump.gain_unit == "1" else "V" if pump.gain_unit.endswith("/V") else "1"


def draw_conditions(rig: Rig, rng: np.random.Generator, inputs: str, coloured: float, rest: Array) -> Conditions:
    """inputs: 'steps' (random steps), 'wide' (from standstill up) or 'poor' (two steps).

    coloured: chance of AR(1) noise. rest (N,): the sound rig's levels at middling inputs, m.
    """
    plant = rig.plant
    recorded = two_steps(rig, rng) if inputs == "poor" else random_steps(rig, rng, RECORDED, inputs == "wide")
    held_out = random_steps(rig, rng, HELD_OUT, inputs == "wide")
    heights = np.array([t.height for t in plant.tanks])
    starts = np.minimum(rest * rng.uniform(0.75, 1.25, size=(2, len(rest))), 0.85 * heights)
    constants = sound_conductance(plant) * (
        1 + tolerance(plant) * np.clip(rng.normal(size=len(plant.pipes)), -2.5, 2.5)
    )
    noise = float(rng.choice([0.05, 0.1, 0.2])) * rig.noise_unit
    colour = float(rng.uniform(0.6, 0.9)) if rng.random() < coloured else 0.0
    return Conditions((recorded, held_out), starts, constants, noise, colour)


def sound_conductance(plant: PlantDescription) -> Array:
    """(P,): discharge coefficient x bore x sqrt(2 g), m^2.5/s."""
    root = np.sqrt(2 * plant.gravity)
    return np.array([p.discharge_coefficient * p.area * root for p in plant.pipes])


def tolerance(plant: PlantDescription) -> Array:
    """(P,): one standard deviation of each discharge coefficient, as a share of it."""
    return np.array([plant.tolerances.get(f"{p.name}.discharge_coefficient", 0.0) for p in plant.pipes])


def channel_limits(rig: Rig, wide: bool = False) -> Array:
    """(C, 2): lowest and highest command of each channel, in the header's unit."""
    low, high = (0.0, 1.1 * rig.input_high) if wide else (rig.input_low, rig.input_high)
    rows = []
    for channel in rig.plant.channels():
        pump = next(p for p in rig.plant.pumps if p.channel == channel)
        full = pump.max_flow / pump.gain / _FACTORS[command_unit(pump)]
        rows.append((low * full, min(high, 1.0) * full))
    return np.array(rows)


def random_steps(rig: Rig, rng: np.random.Generator, samples: int, wide: bool = False) -> Array:
    """Each channel takes a random value for a random while; wide: one in five is a standstill."""
    out = np.empty((samples, len(rig.plant.channels())))
    for column, (low, high) in enumerate(channel_limits(rig, wide)):
        at = 0
        while at < samples:
            hold = int(rng.integers(SHORTEST_HOLD, LONGEST_HOLD))
            value = 0.0 if wide and rng.random() < 0.2 else rng.uniform(low, high)
            out[at : at + hold, column] = value
            at += hold
    return in_print(rig, out)


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
    """(T, C) in the header's unit -> (T, M) m^3/s."""
    channels = plant.channels()
    return np.stack(
        [p.gain * _FACTORS[command_unit(p)] * commands[:, channels.index(p.channel)] for p in plant.pumps], axis=1
    )


def levels_at_rest(rig: Rig) -> Array:
    """(N,) m: where the sound rig comes to rest at middling inputs."""
    middle = in_print(rig, np.tile(channel_limits(rig).mean(axis=1), (4001, 1)))
    asked = asked_of_pumps(rig.plant, middle)[..., None]
    start = np.array([[0.4 * t.height] for t in rig.plant.tanks])
    rigs = HiddenRigs(rig.plant, sound_conductance(rig.plant)[:, None], [()])
    return simulate(rigs, asked, start, _COARSE)[-1, :, 0]


def sound_levels(rig: Rig, all_conditions: list[Conditions]) -> Array:
    """(T, N, L) m: each recording as the rig without any effect would run, coarsely."""
    asked = np.stack([asked_of_pumps(rig.plant, c.commands[0]) for c in all_conditions], axis=-1)
    start = np.stack([c.starts[0] for c in all_conditions], axis=-1)
    conductance = np.stack([c.conductance for c in all_conditions], axis=-1)
    return simulate(HiddenRigs(rig.plant, conductance, [()] * len(all_conditions)), asked, start, _COARSE)


def kept_below_the_rim(rig: Rig, all_conditions: list[Conditions]) -> tuple[list[Conditions], Array]:
    """Turns the inputs of those down whose sound rig comes near its rim; with the sound levels (T, N, L).

    Raises ValueError where that does not help.
    """
    rim = np.array([0.85 * t.height for t in rig.plant.tanks])
    kept, levels = list(all_conditions), sound_levels(rig, all_conditions)
    for _ in range(6):
        high = np.flatnonzero((levels.max(axis=0) > rim[:, None]).any(axis=0))
        if not len(high):
            return kept, levels
        for lane in high:
            recorded, held_out = (in_print(rig, 0.85 * c) for c in kept[lane].commands)
            kept[lane] = replace(kept[lane], commands=(recorded, held_out))
        levels[:, :, high] = sound_levels(rig, [kept[lane] for lane in high])
    raise ValueError(
        f"rig {rig.plant.name}: expected inputs that keep it below its rim, got overflow; lower input_high"
    )
