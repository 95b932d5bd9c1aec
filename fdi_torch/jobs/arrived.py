"""Rows that have arrived from a growing file: as samples, and as the recording a monitor learns its noise from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, pairwise

import torch

from fdi_torch.config.growing_recordings import Row
from fdi_torch.config.monitor_file import MonitorRun
from fdi_torch.logbook import Run as Log
from fdi_torch.logbook import series
from fdi_torch.monitor.samples import GAP, Samples
from fdi_torch.recording import Recording


def samples_of(rows: Sequence[Row], run: MonitorRun) -> Samples:
    """Times, inputs and readings (T, ...) of the rows, in SI."""
    time, inputs, readings = (torch.tensor(column, dtype=torch.float64) for column in zip(*rows, strict=True))
    sensors = len(run.plant.sensors)
    return Samples(time, inputs.reshape(len(time), -1), readings.reshape(-1, sensors), run.config.recording.hold)


def reaching(rows: Sequence[Row], until: float) -> list[Row]:
    """The first of them without a jump back of their clock that reach a moment (s); none while they do not.

    A single stamp far ahead does not reach it, a gap does once GAP samples have come after it.
    """
    stretch: list[Row] = []
    steps: list[float] = []
    beyond = 0
    for row in rows:
        step = row[0] - stretch[-1][0] if stretch else 0.0
        if step == 0.0 and stretch:
            continue
        if step < 0.0:
            stretch, steps, beyond = [], [], 0
        elif stretch:
            steps.append(step)
        stretch.append(row)
        if row[0] < until:
            continue
        beyond += 1
        if beyond >= GAP or (beyond == 1 and steps and step <= GAP * sorted(steps)[len(steps) // 2]):
            return stretch
    return []


def recording_of(rows: Sequence[Row], run: MonitorRun) -> Recording:
    """Rows as a recording, from the last jump of their clock on."""
    if len(rows) < 2:
        raise ValueError(f"{run.config.recording.file}: expected samples to follow, got {len(rows)}")
    once = [rows[0], *(after for before, after in pairwise(rows) if after[0] != before[0])]
    jumps = [k for k in range(1, len(once)) if once[k][0] < once[k - 1][0]]
    samples = samples_of(once[jumps[-1] if jumps else 0 :], run)
    plant = run.plant
    blank = Recording(
        samples.time,
        samples.inputs,
        samples.readings,
        tuple(plant.channels()),
        tuple(sensor.column for sensor in plant.sensors),
        tuple(plant.channel_units().values()),
        tuple(sensor.unit for sensor in plant.sensors),
        hold=samples.hold,
    )
    return replace(blank, source=run.config.recording.file)


def logged_rows(log: Log, run: MonitorRun) -> list[Row]:
    """The samples in a monitor's log, in the order in which they came."""
    inputs, outputs = series(log, "/plant/input"), series(log, "/plant/output")
    count = min(len(inputs["t"]), len(outputs["t"]))  # a run may be killed between the two
    commands = [inputs[name][:count] for name in run.plant.channels()]
    readings = [outputs[sensor.column][:count] for sensor in run.plant.sensors]
    times = inputs["t"][:count].tolist()
    return [(t, [float(c[k]) for c in commands], [float(r[k]) for r in readings]) for k, t in enumerate(times)]


def followed_on(earlier: Sequence[Row], source: Iterable[Row | str]) -> Iterator[Row | str]:
    """A growing file from its beginning; the samples of an earlier log first, where the file no longer holds them."""
    rows = iter(source)
    notices: list[Row | str] = []
    for row in rows:
        if not isinstance(row, str):
            break
        notices.append(row)
    else:
        yield from chain(earlier, notices)
        return
    if _same(row, earlier[0]):
        yield from chain(notices, [row], rows)
        return
    yield from chain(earlier, notices)
    for later in chain([row], rows):
        if isinstance(later, str) or later[0] > earlier[-1][0]:
            yield later


def _same(a: Row, b: Row) -> bool:
    """Whether two rows hold the same; an unknown value equals another unknown one."""
    first, second = ([r[0], *r[1], *r[2]] for r in (a, b))
    return len(first) == len(second) and all(x == y or (x != x and y != y) for x, y in zip(first, second, strict=True))
