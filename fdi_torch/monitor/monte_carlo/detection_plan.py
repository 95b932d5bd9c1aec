"""Monte Carlo plan: detection delay and missed faults of each detector by fault size, and the isolated fault."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from fdi_torch.estimate.proportion import wilson
from fdi_torch.monitor.detection import CHARTS, Detector
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monte_carlo.detector_trials import delays, detectors
from fdi_torch.monitor.monte_carlo.isolation_trials import confusions, isolate_run
from fdi_torch.monitor.monte_carlo.simulated_runs import FaultSchedule, SimulatedRig, fault_free_schedule
from fdi_torch.monitor.monte_carlo.tasks import Numbers, ResultTable, Task, quantiles, seeded_generator
from fdi_torch.monitor.noise_model import NoiseModel, learn_noise

RUNS_AT_ONCE = 50  # runs side by side
NAME = "faults found"


@dataclass(frozen=True)
class DetectionPlan:
    """One fault of the rig's space occurs in each run at `onset` s. sizes: shares of its range. runs: per size. named:
    number of these runs that the complete monitor processes, for each detector.
    """

    rig: SimulatedRig
    monitor: MonitorSettings
    runs: int
    named: int
    samples: int
    sizes: tuple[float, ...]
    onset: float
    every: float
    seed: int

    def tasks(self) -> list[Task]:
        starts = range(0, self.runs, RUNS_AT_ONCE)
        return [
            Task(f"{NAME}/{size:g}", lambda size=size, first=first: self._detect(size, first))  # type: ignore[misc]
            for first in starts
            for size in self.sizes
        ]

    @cached_property
    def _designed(self) -> tuple[NoiseModel, list[Detector]]:
        """Noise model from an hour without a fault, and the detectors for it."""
        rig = self.rig
        training = rig.run(fault_free_schedule(rig.space, 1), 3601, seeded_generator(self.seed, 3))
        noise, _ = learn_noise(rig.network, training.member(0), levels=rig.levels)
        sensors = training.readings.shape[-1]
        return noise, detectors(self.every, rig.sampling, sensors, learnt=noise.whitening)

    def _detect(self, size: float, first: int) -> Numbers:
        rig, row = self.rig, self.sizes.index(size)
        noise, charts = self._designed
        count = min(RUNS_AT_ONCE, self.runs - first)
        schedule, faulty = self._schedule(size, count)
        seen = rig.run(schedule, self.samples, seeded_generator(self.seed, 4, row, first))
        numbers: dict[str, float | list[float] | list[str]] = {"fault": faulty}
        for d in delays(rig, noise, charts, seen, schedule):
            late = [value if value < 1e9 else -1.0 for value in d.delay.tolist()]
            numbers |= {f"{d.chart} delay": late, f"{d.chart} early": float(d.early.sum())}
        for detector in charts:
            monitor = Monitor(rig.network, rig.space, noise, detector, self.monitor)
            share = -(-self.named * count // self.runs)
            numbers[f"{detector.chart} named"] = [
                " + ".join(isolate_run(monitor, seen.member(r), rig.space.nominal(), rig.levels, self.onset).last)
                for r in range(share)
            ]
        return numbers

    def _schedule(self, size: float, count: int) -> tuple[FaultSchedule, list[str]]:
        space = self.rig.space
        theta, which = space.nominal().repeat(count, 1), [r % len(space) for r in range(count)]
        for r, column in enumerate(which):
            p = space.parameters[column]
            theta[r, column] += size * (p.high - p.nominal)
        onset = torch.full((count,), self.onset, dtype=theta.dtype)
        return FaultSchedule(theta, onset, torch.zeros_like(onset)), [space.names[c] for c in which]

    def result_table(self, numbers: Mapping[str, Sequence[Mapping[str, Any]]]) -> ResultTable:
        rows, totals = [], [0, 0, 0, 0]
        for size in self.sizes:
            results = numbers.get(f"{NAME}/{size:g}", ())
            for chart in CHARTS if results else ():
                delay_values = [float("inf") if d < 0 else d for n in results for d in n[f"{chart} delay"]]
                missed, early = (
                    sum(d == float("inf") for d in delay_values),
                    sum(int(n[f"{chart} early"]) for n in results),
                )
                truth = [f for n in results for f in n["fault"][: len(n[f"{chart} named"])]]
                named_faults = [s for n in results for s in n[f"{chart} named"]]
                right = sum(t == s for t, s in zip(truth, named_faults, strict=True))
                low, high = wilson(right, len(named_faults))
                mistakes = confusions(truth, [tuple(s.split(" + ")) if s else () for s in named_faults], 2)
                q = quantiles(delay_values, (0.5, 0.05, 0.95))
                delay = f"{q[0]:.0f} ({q[1]:.0f} … {q[2]:.0f})"
                named = f"{right} of {len(named_faults)} ({100 * low:.0f} … {100 * high:.0f} %)"
                wrong = "; ".join(f"{_short(t)} as {_short(s)}: {n}" for t, s, n in mistakes)
                totals = [
                    a + b for a, b in zip(totals, (missed, len(delay_values), right, len(named_faults)), strict=True)
                ]
                rows.append(
                    (f"{100 * size:g} %", chart, str(len(delay_values)), delay, str(missed), str(early), named, wrong)
                )
        header = ("size", "detector", "runs", "delay, s (5 … 95 %)", "missed", "early", "named right", "mostly wrong")
        summary = f"{totals[0]} of {totals[1]} faults missed, {totals[2]} of {totals[3]} named right"
        return ResultTable("faults found", header, tuple(rows), summary if rows else "")


def _short(names: str) -> str:
    return names.replace(".size", "")
