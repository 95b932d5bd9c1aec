"""Rehearsal: how soon each detector finds faults of some sizes, how many it misses, and which fault is then named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from fdi_torch.estimate.proportion import wilson
from fdi_torch.monitor.detection import CHARTS, Detector
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.noise import Noise, learn_noise
from fdi_torch.monitor.rehearsal.alarms import delays, detectors
from fdi_torch.monitor.rehearsal.naming import confusions, name
from fdi_torch.monitor.rehearsal.pieces import Numbers, Piece, Shown, quantiles, seeded
from fdi_torch.monitor.rehearsal.runs import Course, Rig, fault_free
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.settings import MonitorSettings

PART = 50  # runs side by side
NAME = "faults found"


@dataclass(frozen=True)
class FaultsFoundPlan:
    """rig: its space are the faults, one of which opens in each run at rest at `onset` s, of `sizes` (shares of its
    range). runs: of each size. named: how many of them the whole monitor follows, for each detector.
    """

    rig: Rig
    monitor: MonitorSettings
    runs: int
    named: int
    samples: int
    sizes: tuple[float, ...]
    onset: float
    every: float
    seed: int

    def pieces(self) -> list[Piece]:
        starts = range(0, self.runs, PART)
        return [
            Piece(f"{NAME}/{size:g}", lambda size=size, first=first: self._found(size, first))  # type: ignore[misc]
            for first in starts
            for size in self.sizes
        ]

    @cached_property
    def _ready(self) -> tuple[Noise, list[Detector]]:
        """Noise learnt from an hour without fault, and the detectors that suit it."""
        rig = self.rig
        learnt = rig.run(fault_free(rig.space, 1), 3601, seeded(self.seed, 3))
        noise, _ = learn_noise(rig.network, _one(learnt, 0), levels=rig.levels)
        sensors = learnt.readings.shape[-1]
        return noise, detectors(self.every, rig.sampling, sensors, learnt=noise.whitening)

    def _found(self, size: float, first: int) -> Numbers:
        rig, row = self.rig, self.sizes.index(size)
        noise, charts = self._ready
        count = min(PART, self.runs - first)
        course, faulty = self._course(size, count)
        seen = rig.run(course, self.samples, seeded(self.seed, 4, row, first))
        numbers: dict[str, float | list[float] | list[str]] = {"fault": faulty}
        for d in delays(rig, noise, charts, seen, course):
            late = [value if value < 1e9 else -1.0 for value in d.delay.tolist()]
            numbers |= {f"{d.chart} delay": late, f"{d.chart} early": float(d.early.sum())}
        for detector in charts:
            monitor = Monitor(rig.network, rig.space, noise, detector, self.monitor)
            share = -(-self.named * count // self.runs)
            numbers[f"{detector.chart} named"] = [
                " + ".join(name(monitor, _one(seen, r), rig.space.nominal(), rig.levels, self.onset).last)
                for r in range(share)
            ]
        return numbers

    def _course(self, size: float, count: int) -> tuple[Course, list[str]]:
        space = self.rig.space
        theta, which = space.nominal().repeat(count, 1), [r % len(space) for r in range(count)]
        for r, column in enumerate(which):
            p = space.parameters[column]
            theta[r, column] += size * (p.high - p.nominal)
        onset = torch.full((count,), self.onset, dtype=theta.dtype)
        return Course(theta, onset, torch.zeros_like(onset)), [space.names[c] for c in which]

    def shown(self, found: Mapping[str, Sequence[Mapping[str, Any]]]) -> Shown:
        rows, counted = [], [0, 0, 0, 0]
        for size in self.sizes:
            own = found.get(f"{NAME}/{size:g}", ())
            for chart in CHARTS if own else ():
                late = [float("inf") if d < 0 else d for n in own for d in n[f"{chart} delay"]]
                missed, early = sum(d == float("inf") for d in late), sum(int(n[f"{chart} early"]) for n in own)
                truth = [f for n in own for f in n["fault"][: len(n[f"{chart} named"])]]
                said = [s for n in own for s in n[f"{chart} named"]]
                right = sum(t == s for t, s in zip(truth, said, strict=True))
                low, high = wilson(right, len(said))
                mixed = confusions(truth, [tuple(s.split(" + ")) if s else () for s in said], 2)
                q = quantiles(late, (0.5, 0.05, 0.95))
                delay = f"{q[0]:.0f} ({q[1]:.0f} .. {q[2]:.0f})"
                named = f"{right} of {len(said)} ({100 * low:.0f} .. {100 * high:.0f} %)"
                wrong = "; ".join(f"{_short(t)} as {_short(s)}: {n}" for t, s, n in mixed)
                counted = [a + b for a, b in zip(counted, (missed, len(late), right, len(said)), strict=True)]
                rows.append((f"{100 * size:g} %", chart, str(len(late)), delay, str(missed), str(early), named, wrong))
        header = ("size", "detector", "runs", "delay, s (5 .. 95 %)", "missed", "early", "named right", "mostly wrong")
        found_so = f"{counted[0]} of {counted[1]} faults missed, {counted[2]} of {counted[3]} named right"
        return Shown("faults found", header, tuple(rows), found_so if rows else "")


def _one(samples: Samples, run: int) -> Samples:
    inputs = samples.inputs[run] if samples.inputs.dim() > 2 else samples.inputs
    return Samples(samples.time, inputs, samples.readings[run])


def _short(names: str) -> str:
    return names.replace(".size", "")
