"""Simulator of the hidden rigs, independent of the library: plain NumPy with a step of 0.02 s, many rigs at once.

It integrates volumes, not levels: V' = inflow - outflow, with h = h(V) by inverting V(h) = integral of A(h).
Inflow is averaged over the step; level-dependent flows are extrapolated by Adams-Bashforth 2:
    V_{n+1} = V_n + dt (pumped_n + disturbance_n + 3/2 f_n - 1/2 f_{n-1}).
Water above a rim at the end of a step overflows at once, into the receiving tank or outside. All tanks of all rigs are
in one vector, and so are pipes and pumps, so that rigs of different layouts run together. Each tank's flows are summed
in the order of its rig's pipes, so that a rig's result does not depend on the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fdi_torch.blind.deviation import Array, Deviation, Index, Moment
from fdi_torch.blind.inputs import Controller, LevelControl
from fdi_torch.blind.laws_pipe import HEAD_LAWS, PIPE_LAWS
from fdi_torch.blind.laws_pump import PUMP_LAWS
from fdi_torch.blind.laws_tank import STORAGE_LAWS, TANK_LAWS
from fdi_torch.plant.description import OUTSIDE, PlantDescription

STEP = 0.02
_GRID = 4001


def conductance(plant: PlantDescription) -> Array:
    """(P,): discharge coefficient x bore x sqrt(2 g), m^2.5/s."""
    root = np.sqrt(2 * plant.gravity)
    return np.array([p.discharge_coefficient * p.area * root for p in plant.pipes])


@dataclass
class Group:
    """The places of one law. spot, other (n,): index of the component, and of the tank at its other end."""

    law: Callable[..., Any]
    spot: Index
    other: Index
    numbers: dict[str, Array]
    state: Any = None


def grouped(
    laws: Mapping[str, Callable[..., Any]],
    names: Sequence[Sequence[str]],
    deviations: Sequence[Sequence[Deviation]],
    tanks: Sequence[Sequence[str]] = (),
) -> list[Group]:
    """One group a law, in the order of `laws`. names, tanks: the components of each rig in their order.

    Raises ValueError where a rig has one law twice.
    """
    first = np.cumsum([0, *(len(own) for own in names)])
    first_tank = np.cumsum([0, *(len(own) for own in tanks)])
    groups = []
    for name, law in laws.items():
        matching = [(rig, d) for rig, ds in enumerate(deviations) for d in ds if d.law == name]
        if not matching:
            continue
        if len({rig for rig, _ in matching}) < len(matching):
            raise ValueError(f"expected each law once in a rig, got {name} twice; draw another place")
        spot = [first[rig] + list(names[rig]).index(d.location.split("-")[0]) for rig, d in matching]
        other = [
            first_tank[rig] + list(tanks[rig]).index(d.other) if d.other else first_tank[-1] for rig, d in matching
        ]
        numbers = {key: np.array([d.numbers[key] for _, d in matching]) for key in matching[0][1].numbers}
        groups.append(Group(law, np.array(spot, dtype=np.intp), np.array(other, dtype=np.intp), numbers))
    return groups


class HiddenRigs:
    """A batch of rigs, each with its plant as built and its deviations."""

    def __init__(self, built: Sequence[PlantDescription], deviations: Sequence[Sequence[Deviation]]) -> None:
        tanks = [[t.name for t in plant.tanks] for plant in built]
        pipes = [[p.name for p in plant.pipes] for plant in built]
        pumps = [[p.name for p in plant.pumps] for plant in built]
        self.first_tank, self.first_pump = (np.cumsum([0, *map(len, names)]) for names in (tanks, pumps))
        self.count = count = int(self.first_tank[-1])

        def spot(rig: int, tank: str) -> int:
            return count if tank == OUTSIDE else int(self.first_tank[rig]) + tanks[rig].index(tank)

        def spots(of: Callable[[PlantDescription], list[str]]) -> Index:
            return np.array([spot(rig, name) for rig, plant in enumerate(built) for name in of(plant)], dtype=np.intp)

        self.area = np.array([t.area for plant in built for t in plant.tanks])
        self.caught = spots(lambda plant: [t.overflow_to for t in plant.tanks])
        self.source = spots(lambda plant: [p.source for p in plant.pipes])
        self.target = spots(lambda plant: [p.target for p in plant.pipes])
        self.fed = spots(lambda plant: [p.target for p in plant.pumps])
        self.conductance = np.concatenate([conductance(plant) for plant in built])
        self.elevation = np.array([p.elevation for plant in built for p in plant.pipes])
        self.submerged = np.array([0.0 if p.is_outlet else 1.0 for plant in built for p in plant.pipes])
        self.pump_groups = grouped(PUMP_LAWS, pumps, deviations)
        self.head_groups = grouped(HEAD_LAWS, pipes, deviations)
        self.pipe_groups = grouped(PIPE_LAWS, pipes, deviations)
        self.tank_groups = grouped(TANK_LAWS, tanks, deviations, tanks)
        every_tank = [t for plant in built for t in plant.tanks]
        self.tables = [
            VolumeTable(every_tank[at], group.law, {k: v[i : i + 1] for k, v in group.numbers.items()}, at)
            for group in grouped(STORAGE_LAWS, tanks, deviations)
            for i, at in enumerate(group.spot.tolist())
        ]
        # All tables in one array (n, grid), so that one look-up serves all tanks.
        self.table_spot = np.array([t.spot for t in self.tables], dtype=np.intp)
        self.table_levels = np.concatenate([np.zeros(0), *(t.levels for t in self.tables)])
        self.table_last = np.array([t.volumes_per_cell for t in self.tables])
        self.table_base = np.arange(len(self.tables)) * _GRID
        self.rim = self.volumes(np.array([t.height for t in every_tank]))

    def volumes(self, levels: Array) -> Array:
        """Volumes (N,) m^3 from levels (N,) m."""
        volume = self.area * levels
        for table in self.tables:
            volume[table.spot] = table.volume(levels[table.spot])
        return volume

    def levels(self, volume: Array) -> Array:
        """Levels (N,) m from volumes (N,) m^3."""
        level = volume / self.area
        if self.tables:
            x = volume[self.table_spot] / self.table_last
            cell = np.minimum(np.maximum(x, 0.0), _GRID - 2).astype(np.intp)
            at = self.table_base + cell
            low, high = self.table_levels[at], self.table_levels[at + 1]
            level[self.table_spot] = low + (x - cell) * (high - low)
        return level

    def spilled(self, volume: Array) -> Array:
        """Volumes (N,) m^3 after overflow: without the water above the rims, plus overflow from other tanks."""
        over = np.maximum(volume - self.rim, 0.0)
        return volume - over + self._into(self.caught, over) if over.any() else volume

    def pumped(
        self, level: Array, asked: Array, time: float, dt: float, past: Callable[[Group, Array], Array]
    ) -> Array:
        """Inflow of each tank from its pumps (N,), m^3/s. asked (M,): requested flows."""
        q = asked.copy()
        for group in self.pump_groups:
            now = Moment(time, dt, level[self.fed[group.spot]], lambda delay, g=group: past(g, delay))  # type: ignore[misc]
            q[group.spot], group.state = group.law(q[group.spot], now, group.numbers, group.state)
        return self._into(self.fed, q)

    def drained(self, level: Array, time: float, dt: float) -> Array:
        """Net inflow (N,) of each tank from all level-dependent flows, m^3/s."""
        wet = np.append(np.maximum(level, 0.0), 0.0)
        now = Moment(time, dt, level, _no_command)
        q = self.piped(wet, now)
        net = self._into(self.target, q) - self._into(self.source, q)
        for group in self.tank_groups:
            q, group.state = group.law(level[group.spot], wet[group.other], now, group.numbers, group.state)
            net += self._into(group.other, q) - self._into(group.spot, q)
        return net

    def piped(self, wet: Array, now: Moment) -> Array:
        """Flow (P,) of each pipe from its source, m^3/s. wet (N + 1,): levels and the outside, m."""
        above = np.maximum(wet[self.source] - self.elevation, 0.0)
        head = above - np.maximum(wet[self.target] - self.elevation, 0.0) * self.submerged
        for group in self.head_groups:
            head[group.spot] = group.law(head[group.spot], group.numbers)
        q = self.conductance * np.copysign(np.sqrt(np.abs(head)), head)
        for group in self.pipe_groups:
            through = q[group.spot]
            factor, group.state = group.law(head[group.spot], through, now, group.numbers, group.state)
            q[group.spot] = through * factor
        return q

    def _into(self, tanks: Index, q: Array) -> Array:
        """(N,): sum of the flows (or volumes) into each tank; those to the outside are dropped."""
        sums: Array = np.bincount(tanks, weights=q, minlength=self.count + 1).astype(np.float64, copy=False)
        return sums[:-1]


class VolumeTable:
    """V(h) of one tank with varying cross-section, inverted onto an even grid of volumes up to the rim."""

    def __init__(self, tank: Any, law: Callable[..., Array], numbers: dict[str, Array], spot: int) -> None:
        self.spot = spot
        self._h = np.linspace(0.0, tank.height, 4 * _GRID)
        share = law(self._h[:, None], numbers)[:, 0] * tank.area
        self._v = np.concatenate(([0.0], np.cumsum(0.5 * (share[1:] + share[:-1]) * np.diff(self._h))))
        self.volumes_per_cell = float(self._v[-1]) / (_GRID - 1)
        self.levels = np.interp(np.arange(_GRID) * self.volumes_per_cell, self._v, self._h)

    def volume(self, level: float) -> float:
        return float(np.interp(level, self._h, self._v))


def _no_command(delay: Array) -> Array:
    raise ValueError("expected a pump where a past command is asked for, got a tank or a pipe; use a pump law")


@dataclass(frozen=True)
class Drive:
    """The inputs of one simulated rig. asked (T, M): commanded flow of each pump, m^3/s, held for the next second.

    start (N,): initial levels, m. disturbance (T, N): random flow into each tank, m^3/s, held likewise. control: a
    controller of one level by one pump; error (T,): the error of its level measurement, m.
    """

    asked: Array
    start: Array
    disturbance: Array | None = None
    control: LevelControl | None = None
    error: Array | None = None


@dataclass(frozen=True)
class SimulatedRun:
    """levels (T, N) m at 0, 1, 2, ... s, and requested flows asked (T, M) m^3/s, including those of a level control."""

    levels: Array
    asked: Array


def simulate(rigs: HiddenRigs, drives: Sequence[Drive], step: float = STEP) -> list[SimulatedRun]:
    """Simulate all rigs at once; drives[i] holds the inputs, initial levels and disturbances of rig i.

    Raises ValueError where a second is not a whole number of steps.
    """
    per_second = round(1 / step)
    if abs(per_second * step - 1) > 1e-9:
        raise ValueError(f"expected a step that divides one second, got {step} s; take for example 0.02 s")
    lengths = [len(drive.asked) for drive in drives]
    rows = [np.minimum(np.arange(max(lengths)), own - 1) for own in lengths]
    asked = np.concatenate([drive.asked[row] for drive, row in zip(drives, rows, strict=True)], axis=1)
    disturbance = _disturbances(rigs, drives, rows)
    controls = [
        (Controller(drive.control), int(rigs.first_tank[i]), int(rigs.first_pump[i]), drive.error)
        for i, drive in enumerate(drives)
        if drive.control
    ]
    volume, before = rigs.volumes(np.concatenate([drive.start for drive in drives])), None
    levels = np.empty((len(asked), rigs.count))
    for n in range((len(asked) - 1) * per_second + 1):
        time, level, second = n * step, rigs.levels(volume), n // per_second
        if n % per_second == 0:
            levels[second] = level
            for control, tank, pump, error in controls:
                off = 0.0 if error is None else float(error[min(second, len(error) - 1)])
                asked[second, pump + control.pump] = control.flow(second, float(level[tank + control.tank]) + off)
        if second == len(asked) - 1:
            break

        def past(group: Group, delay: Array, now: float = (n + 0.5) * step) -> Array:
            return asked[np.maximum(np.floor(now - delay), 0).astype(np.intp), group.spot]

        given = rigs.pumped(level, asked[second], time, step, past)
        drained = rigs.drained(level, time, step)
        volume = volume + step * (drained if before is None else 1.5 * drained - 0.5 * before)
        volume += step * (given if disturbance is None else given + disturbance[second])
        volume = rigs.spilled(volume)
        before = drained
    return [
        SimulatedRun(levels[:own, t : rigs.first_tank[i + 1]], asked[:own, p : rigs.first_pump[i + 1]])
        for i, (own, t, p) in enumerate(zip(lengths, rigs.first_tank, rigs.first_pump, strict=False))
    ]


def _disturbances(rigs: HiddenRigs, drives: Sequence[Drive], rows: Sequence[Index]) -> Array | None:
    """Disturbance flows (T, N) of all rigs, m^3/s; None if no rig is disturbed."""
    if all(drive.disturbance is None for drive in drives):
        return None
    widths = np.diff(rigs.first_tank)
    parts = zip(drives, rows, widths, strict=True)
    return np.concatenate(
        [np.zeros((len(row), wide)) if d.disturbance is None else d.disturbance[row] for d, row, wide in parts], axis=1
    )
