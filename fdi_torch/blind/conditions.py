"""Conditions of a case: inputs, initial levels, calibration constants, noise, disturbances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fdi_torch.blind.deviation import Array, Deviation
from fdi_torch.blind.inputs import (
    DECIMALS,
    FACTORS,
    LevelControl,
    as_printed,
    channel_limits,
    command_unit,
    commanded,
    draw_control,
    drawn,
    pumps_of_channels,
    with_standstills,
)
from fdi_torch.blind.plants import BENCH, Rig, Scales, on_bench
from fdi_torch.blind.random_flows import Disturbance
from fdi_torch.blind.sensor_noise import WHITE, NoiseCorrelation, draw_correlation
from fdi_torch.blind.simulator import Drive, HiddenRigs, SimulatedRun, simulate
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription

RECORDED, HELD_OUT = 3601, 2401
"""Samples of the recording and of the hold-out, one per second."""
COARSE = 0.25
"""Integration step of preliminary simulations, s."""
WIDEST, _LEAST = 2.5, 0.2
"""Largest deviation of a constant, in standard deviations, and its smallest value, as a share of the nominal one."""
_MOST_TRIALS = 12
"""Number of adjustments of the inputs after which a rig counts as one that no inputs keep within its tanks."""
LOW, HIGH = 0.13, 0.8
"""Range of the commanded flow, as a share of a pump's max_flow, of a rig that only its plant file describes."""
FULL, LEAST = 0.5, 0.02
"""Highest resting level of such a rig, as a share of the height, above which HIGH is reduced; and its lower limit."""
NOISE = 1 / 35
"""Unit of the measurement noise over the mean level at equilibrium: 0.05, 0.1 or 0.2 of it are 0.14, 0.29 or 0.57 %."""


@dataclass(frozen=True)
class Conditions:
    """Conditions of recording and hold-out.

    commands: (T, C) each, in the header's unit. signal: name of the recording's signal. starts (2, N) m: initial
    levels. built: the rig with its true constants. noise (S,): standard deviation of each sensor's readings, m; errors:
    (T, S) m each. control: of both parts, if a level is controlled. disturbances (T, N) m^3/s: of both parts, if any;
    disturbance: how they were drawn.
    """

    rig: Rig
    commands: tuple[Array, Array]
    signal: str
    starts: Array
    built: PlantDescription
    noise: Array
    correlation: NoiseCorrelation
    errors: tuple[Array, ...] = ()
    control: tuple[LevelControl, ...] = ()
    disturbance: Disturbance | None = None
    disturbances: tuple[Array, ...] = ()

    def drive(self, part: int, disturbed: bool) -> Drive:
        """Inputs of the simulation of the recording (part 0) or the hold-out (part 1)."""
        asked, control = asked_of_pumps(self.built, self.commands[part]), self.control[part] if self.control else None
        error = None if control is None else self.errors[part][:, self.rig.measured_tanks.index(control.tank)]
        disturbance = self.disturbances[part] if disturbed and self.disturbances else None
        return Drive(asked, self.starts[part], disturbance, control, error)


def as_built(plant: PlantDescription, rng: np.random.Generator) -> PlantDescription:
    """The rig as built: constants x (1 + s z), offsets x + s z, with tolerance s and z standard normal, clipped."""
    drawn: dict[str, dict[str, Any]] = {}
    for constant, tolerance in plant.tolerances.items():
        name = ParameterName.parse(constant)
        z = float(np.clip(rng.normal(), -WIDEST, WIDEST))
        nominal = float(getattr(plant.component(name.place), name.field))
        value = nominal + tolerance * z if name.field == "offset" else nominal * max(1 + tolerance * z, _LEAST)
        drawn.setdefault(name.place, {})[name.field] = value
    parts: dict[str, Any] = {
        part: tuple(replace(c, **drawn.get(c.name, {})) for c in getattr(plant, part))
        for part in ("tanks", "pipes", "pumps", "sensors")
    }
    return replace(plant, **parts)


def draw_conditions(
    rig: Rig, rng: np.random.Generator, inputs: str, coloured: float, rest: Array, resting: str | None = None
) -> Conditions:
    """Draw the conditions of a case.

    inputs: 'rich', 'poor' (in the recording) or 'steps'. coloured: probability of correlated noise. rest (N,):
    equilibrium levels without any effect at medium inputs, m. resting: a channel that is often at rest.
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
    correlation = draw_correlation(rng) if rng.random() < coloured else WHITE
    return Conditions(rig, (commands[0], commands[1]), name, starts, built, noise, correlation)


def asked_of_pumps(plant: PlantDescription, commands: Array) -> Array:
    """(T, C) in the header's unit -> (T, M) m^3/s, within each pump's range."""
    channels = plant.channels()
    flows = [p.gain * FACTORS[command_unit(p)] * commands[:, channels.index(p.channel)] for p in plant.pumps]
    return np.stack([np.clip(q, 0.0, p.max_flow) for p, q in zip(plant.pumps, flows, strict=True)], axis=1)


def commands_of_pumps(plant: PlantDescription, asked: Array) -> Array:
    """(T, M) m^3/s -> (T, C) in the header's unit, each channel from its first pump."""
    columns = []
    for p in pumps_of_channels(plant):
        requested, unit = asked[:, plant.pumps.index(p)], command_unit(p)
        columns.append(np.round(requested / (p.gain * FACTORS[unit]), DECIMALS[unit]))
    return np.stack(columns, axis=1)


Deviations = tuple[Deviation, ...]
"""Differences of a rig from its plant file."""
Lane = tuple[Conditions, int, Deviations, bool]
"""One simulation: conditions, part (0 recording, 1 hold-out), deviations, whether random flows act."""


def simulated(lanes: Sequence[Lane], step: float) -> list[SimulatedRun]:
    """All simulations in one batch, with integration steps of `step` s."""
    if not lanes:
        return []
    rigs = HiddenRigs([c.built for c, *_ in lanes], [off for _, _, off, _ in lanes])
    return simulate(rigs, [c.drive(part, disturbed) for c, part, _, disturbed in lanes], step)


def levels_at_rest(rig: Rig) -> Array:
    """Equilibrium levels (N,) m of the rig without any effect at medium inputs."""
    if rig.rest is not None:
        return np.array(rig.rest)
    middle = as_printed(rig, np.tile(channel_limits(rig).mean(axis=1), (4001, 1)))
    start = np.array([0.4 * t.height for t in rig.plant.tanks])
    (ran,) = simulate(HiddenRigs([rig.plant], [()]), [Drive(asked_of_pumps(rig.plant, middle), start)], COARSE)
    return ran.levels[-1]


def nominal_runs(conditions: Sequence[Conditions], part: int, disturbed: bool = False) -> list[SimulatedRun]:
    """Coarse simulations of each recording (part 0) or hold-out (part 1) without any effect."""
    return simulated([(c, part, (), disturbed) for c in conditions], COARSE)


def kept_within(conditions: Sequence[Conditions]) -> list[Conditions]:
    """Adjust the inputs so that the rig without any effect stays away from its rims, and from its floors if required.

    Inputs are lowered (raised) if levels are only too high (low), otherwise contracted about their mean. Raises
    ValueError if that does not help.
    """
    kept, todo = list(conditions), list(range(len(conditions)))
    for _ in range(_MOST_TRIALS):
        runs = [nominal_runs([kept[i] for i in todo], part) for part in (0, 1)]
        outside = []
        for i, *both in zip(todo, *runs, strict=True):
            c = kept[i]
            heights = np.array([t.height for t in c.rig.plant.tanks])
            shares = np.concatenate([ran.levels for ran in both]) / heights
            low, high = c.rig.lowest > shares.min(), c.rig.highest < shares.max()
            if low or high:
                outside.append(i)
                kept[i] = replace(c, commands=tuple(_moved(c.rig, u, low, high) for u in c.commands))
        todo = outside
        if not todo:
            return kept
    name = kept[todo[0]].rig.plant.name
    raise ValueError(f"rig {name}: expected inputs that keep it below its rim, got overflow; lower input_high")


def _moved(rig: Rig, commands: Array, low: bool, high: bool) -> Array:
    if not low:
        return as_printed(rig, 0.85 * commands)
    middle = commands.mean(axis=0)
    return as_printed(rig, middle + 0.85 * (commands - middle) if high else 0.9 * commands + 0.1 * commands.max(axis=0))


def controlled(c: Conditions, rng: np.random.Generator, runs: Sequence[SimulatedRun]) -> Conditions:
    """The conditions with a level control on one pump. runs: open-loop runs without any effect, both parts."""
    limits, channels = channel_limits(c.rig), c.rig.plant.channels()
    flows = np.array([p.gain * FACTORS[command_unit(p)] for p in c.rig.plant.pumps])
    quanta = np.array([10.0 ** -DECIMALS[command_unit(p)] for p in c.rig.plant.pumps])
    rows = limits[[channels.index(p.channel) for p in c.rig.plant.pumps]] * flows[:, None]
    control = draw_control(rng, c.rig.plant, [ran.levels for ran in runs], rows, flows * quanta)
    return replace(c, control=control)


def disturbed(
    conditions: Sequence[Conditions], disturbances: Sequence[Disturbance], generators: Sequence[np.random.Generator]
) -> list[Conditions]:
    """The conditions with random flows into each tank, scaled so that measured levels move by `ratio` times the noise.

    The scale follows from two coarse runs, because levels respond almost linearly.
    """
    drawn = [
        tuple(d.values(rng, len(u)) for u in c.commands)
        for c, d, rng in zip(conditions, disturbances, generators, strict=True)
    ]
    still = nominal_runs(conditions, 0)
    scales = [0.02 * float(asked_of_pumps(c.built, c.commands[0]).mean()) for c in conditions]
    for trial in range(3):
        out = [
            replace(c, disturbance=d, disturbances=tuple(scale * values for values in unscaled))
            for c, d, unscaled, scale in zip(conditions, disturbances, drawn, scales, strict=True)
        ]
        if trial < 2:
            moved = nominal_runs(out, 0, disturbed=True)
            ratios = [moved_by(c, a.levels, b.levels) for c, a, b in zip(out, moved, still, strict=True)]
            scales = [s * d.ratio / r for s, d, r in zip(scales, disturbances, ratios, strict=True)]
    return out


def moved_by(c: Conditions, levels: Array, others: Array) -> float:
    """Root mean square difference of the measured levels, in units of each sensor's noise."""
    return float(np.sqrt(np.mean(((levels - others)[:, c.rig.measured_tanks] / c.noise) ** 2)))


def exercised(plant: PlantDescription, scales: Scales = BENCH) -> Rig:
    """A rig that is described only by its plant file, with the widest inputs at whose middle no tank is above half its
    height in equilibrium.

    scales: its size and time scale relative to a bench-scale rig. Cases are simulated at bench scale and recorded at
    the plant's own scale: a water tower's recording lasts for days. Raises ValueError for valves, for a rig without
    pumps or sensors, and if every input overfills it.
    """
    rig = Rig(on_bench(plant, scales), LOW, HIGH, full_size=plant, scales=scales)
    while ((rest := levels_at_rest(rig)) > [FULL * t.height for t in rig.plant.tanks]).any():
        rig = replace(rig, input_low=0.9 * rig.input_low, input_high=0.9 * rig.input_high)
        if rig.input_high < LEAST:
            raise ValueError(
                f"{plant.title}: expected inputs at which no tank rests above half its height, got none above "
                f"{100 * LEAST:.0f} % of max_flow; check that every tank drains"
            )
    return replace(rig, noise_unit=NOISE * float(rest.mean()))
