"""The hidden rigs, many at once: a second, independent simulation in plain NumPy at a step of 0.02 s.

It integrates volumes, not levels: V' = inflow - outflow, with h = h(V) by inverting V(h) = integral of A(h).
Inflow is a mean over the step; the flows that depend on levels are extrapolated by Adams-Bashforth 2:
    V_{n+1} = V_n + dt (pumped_n + 3/2 f_n - 1/2 f_{n-1}).
What stands above a rim at the end of a step runs over it at once, into the tank that catches it or outside.
Every operation is elementwise over lanes, so a lane does not depend on its neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fdi_torch.gap.challenge.built import conductance
from fdi_torch.gap.challenge.laws_pipe import HEAD_LAWS, PIPE_LAWS
from fdi_torch.gap.challenge.laws_pump import PUMP_LAWS
from fdi_torch.gap.challenge.laws_tank import STORAGE_LAWS, TANK_LAWS
from fdi_torch.gap.challenge.moment import Array, Deviation, Index, Moment
from fdi_torch.plant.description import OUTSIDE, PlantDescription

STEP = 0.02
_GRID = 4001


@dataclass
class Group:
    """The lanes in which one law is at work. spot (n,): flat index of component and lane in (components, lanes)."""

    law: Callable[..., Any]
    rows: Index
    lanes: Index
    spot: Index
    other: Index
    numbers: dict[str, Array]
    state: Any = field(default=None)


def grouped(
    laws: Mapping[str, Callable[..., Any]],
    names: Sequence[str],
    deviations: Sequence[Sequence[Deviation]],
    tanks: Sequence[str] = (),
) -> list[Group]:
    """One group a law, in the order of `laws`. names: components in the order of their rows."""
    groups = []
    for name, law in laws.items():
        found = [(lane, d) for lane, ds in enumerate(deviations) for d in ds if d.law == name]
        if not found:
            continue
        rows = np.array([names.index(d.location.split("-")[0]) for _, d in found])
        lanes = np.array([lane for lane, _ in found])
        if len(set(lanes.tolist())) < len(lanes):
            raise ValueError(f"expected each law once in a rig, got {name} twice; draw another place")
        other = np.array([tanks.index(d.other) if d.other else len(tanks) for _, d in found])
        numbers = {key: np.array([d.numbers[key] for _, d in found]) for key in found[0][1].numbers}
        groups.append(Group(law, rows, lanes, rows * len(deviations) + lanes, other, numbers))
    return groups


class HiddenRigs:
    """A batch of rigs of one layout, a plant as built and what is off there for each lane."""

    def __init__(self, built: Sequence[PlantDescription], deviations: Sequence[Sequence[Deviation]]) -> None:
        plant, self.count = built[0], len(built)
        tanks = [t.name for t in plant.tanks]
        pipes, pumps = [p.name for p in plant.pipes], [p.name for p in plant.pumps]
        self.conductance = np.stack([conductance(p) for p in built], axis=-1)
        self.area = np.array([[p.tanks[i].area for p in built] for i in range(len(tanks))])
        self.caught = np.array([(*tanks, OUTSIDE).index(t.overflow_to) for t in plant.tanks], dtype=np.intp)
        self.source = np.array([tanks.index(p.source) for p in plant.pipes], dtype=np.intp)
        self.target = np.array([(*tanks, OUTSIDE).index(p.target) for p in plant.pipes], dtype=np.intp)
        self.fed = np.array([tanks.index(p.target) for p in plant.pumps], dtype=np.intp)
        self.elevation = np.array([[p.elevation] for p in plant.pipes])
        self.submerged = np.array([[0.0 if p.is_outlet else 1.0] for p in plant.pipes])
        self.pump_groups = grouped(PUMP_LAWS, pumps, deviations)
        self.head_groups = grouped(HEAD_LAWS, pipes, deviations)
        self.pipe_groups = grouped(PIPE_LAWS, pipes, deviations)
        self.tank_groups = grouped(TANK_LAWS, tanks, deviations, tanks)
        self.tables = [
            VolumeTable(
                built[lane].tanks[row], group.law, {k: v[i : i + 1] for k, v in group.numbers.items()}, row, lane
            )
            for group in grouped(STORAGE_LAWS, tanks, deviations)
            for i, (row, lane) in enumerate(zip(group.rows, group.lanes, strict=True))
        ]
        self._stack_tables()
        self.rim = self.volumes(np.array([[p.tanks[i].height for p in built] for i in range(len(tanks))]))

    def _stack_tables(self) -> None:
        """All tables in one array (n, grid), so that one look-up serves all lanes."""
        self.table_spot = np.array([t.row * self.count + t.lane for t in self.tables], dtype=np.intp)
        if self.tables:
            self.table_levels = np.concatenate([t.levels for t in self.tables])
            self.table_last = np.array([t.volumes_per_cell for t in self.tables])
            self.table_base = np.arange(len(self.tables)) * _GRID

    def volumes(self, levels: Array) -> Array:
        """(N, L) m -> m^3."""
        volume = self.area * levels
        for table in self.tables:
            volume[table.row, table.lane] = table.volume(levels[table.row, table.lane])
        return volume

    def levels(self, volume: Array) -> Array:
        """(N, L) m^3 -> m."""
        level = volume / self.area
        if self.tables:
            x = volume.reshape(-1)[self.table_spot] / self.table_last
            cell = np.minimum(np.maximum(x, 0.0), _GRID - 2).astype(np.intp)
            at = self.table_base + cell
            low, high = self.table_levels[at], self.table_levels[at + 1]
            level.reshape(-1)[self.table_spot] = low + (x - cell) * (high - low)
        return level

    def spilled(self, volume: Array) -> Array:
        """(N, L) m^3, less what stands above the rims, plus what runs over into other tanks."""
        over = np.maximum(volume - self.rim, 0.0)
        if not over.any():
            return volume
        kept = np.concatenate((volume - over, np.zeros((1, self.count))))
        for tank, into in enumerate(self.caught):
            kept[into] += over[tank]
        return kept[:-1]

    def pumped(
        self, level: Array, asked: Array, time: float, dt: float, past: Callable[[Group, Array], Array]
    ) -> Array:
        """What the pumps deliver (M, L), m^3/s."""
        if not self.pump_groups:
            return asked
        q = asked.copy()
        flat = q.reshape(-1)
        for group in self.pump_groups:
            here = level[self.fed[group.rows], group.lanes]
            now = Moment(time, dt, here, lambda delay, g=group: past(g, delay))  # type: ignore[misc]
            flat[group.spot], group.state = group.law(flat[group.spot], now, group.numbers, group.state)
        return q

    def drained(self, level: Array, time: float, dt: float) -> Array:
        """Net inflow (N, L) of each tank by all that depends on levels, m^3/s."""
        lanes = level.shape[1]
        wet = np.concatenate((np.maximum(level, 0.0), np.zeros((1, lanes))))
        net = np.zeros((len(level) + 1, lanes))
        now = Moment(time, dt, level, _no_command)
        for pipe, q in enumerate(self.piped(wet, now)):
            net[self.source[pipe]] -= q
            net[self.target[pipe]] += q
        for group in self.tank_groups:
            args = (level.reshape(-1)[group.spot], wet[group.other, group.lanes], now, group.numbers, group.state)
            q, group.state = group.law(*args)
            net[group.rows, group.lanes] -= q
            net[group.other, group.lanes] += q
        return net[:-1]

    def piped(self, wet: Array, now: Moment) -> Array:
        """Flow (P, L) of each pipe from its source on, m^3/s. wet (N + 1, L): levels and the outside, m."""
        above = np.maximum(wet[self.source] - self.elevation, 0.0)
        head = above - np.maximum(wet[self.target] - self.elevation, 0.0) * self.submerged
        for group in self.head_groups:
            head.reshape(-1)[group.spot] = group.law(head.reshape(-1)[group.spot], group.numbers)
        q = self.conductance * np.copysign(np.sqrt(np.abs(head)), head)
        for group in self.pipe_groups:
            there, through = head.reshape(-1)[group.spot], q.reshape(-1)[group.spot]
            factor, group.state = group.law(there, through, now, group.numbers, group.state)
            q.reshape(-1)[group.spot] = through * factor
        return q


class VolumeTable:
    """V(h) of one tank whose cross-section varies, inverted onto an even grid of volumes up to the rim."""

    def __init__(self, tank: Any, law: Callable[..., Array], numbers: dict[str, Array], row: int, lane: int) -> None:
        self.row, self.lane = row, lane
        self._h = np.linspace(0.0, tank.height, 4 * _GRID)
        share = law(self._h[:, None], numbers)[:, 0] * tank.area
        self._v = np.concatenate(([0.0], np.cumsum(0.5 * (share[1:] + share[:-1]) * np.diff(self._h))))
        self.volumes_per_cell = float(self._v[-1]) / (_GRID - 1)
        self.levels = np.interp(np.arange(_GRID) * self.volumes_per_cell, self._v, self._h)

    def volume(self, level: float) -> float:
        return float(np.interp(level, self._h, self._v))


def _no_command(delay: Array) -> Array:
    raise ValueError("expected a pump where a past command is asked for, got a tank or a pipe; use a pump law")


def simulate(rigs: HiddenRigs, asked: Array, start: Array, step: float = STEP) -> Array:
    """Levels (T, N, L) m at 0, 1, 2, ... s.

    asked (T, M, L): flow asked of each pump, m^3/s, held over the second that follows. start (N, L) m.
    Raises ValueError where a second is not a whole number of steps.
    """
    per_second = round(1 / step)
    if abs(per_second * step - 1) > 1e-9:
        raise ValueError(f"expected a step that divides one second, got {step} s; take for example 0.02 s")
    volume = rigs.volumes(start)
    levels = np.empty((len(asked), *start.shape))
    levels[0], before = start, None
    for n in range((len(asked) - 1) * per_second):
        time, level = n * step, rigs.levels(volume)

        def past(group: Group, delay: Array, now: float = (n + 0.5) * step) -> Array:
            row = np.maximum(np.floor(now - delay), 0).astype(np.intp)
            return asked[row, group.rows, group.lanes]

        pumped = rigs.pumped(level, asked[n // per_second], time, step, past)
        drained = rigs.drained(level, time, step)
        volume = volume + step * (drained if before is None else 1.5 * drained - 0.5 * before)
        for pump, tank in enumerate(rigs.fed):
            volume[tank] += step * pumped[pump]
        volume = rigs.spilled(volume)
        before = drained
        if (n + 1) % per_second == 0:
            levels[(n + 1) // per_second] = rigs.levels(volume)
    return levels
