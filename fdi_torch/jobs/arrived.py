"""Rows that have arrived from a growing file: as samples, and as the recording a monitor learns its noise from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch

from fdi_torch.config.growing import Row
from fdi_torch.config.monitor import MonitorRun
from fdi_torch.monitor.continuity import GAP
from fdi_torch.monitor.samples import Samples
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
