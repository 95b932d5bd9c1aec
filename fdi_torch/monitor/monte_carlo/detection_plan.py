"""Monte Carlo plans: detection delay and missed faults of each detector by fault size, with the isolated fault, and
false alarms when the noise model was learnt from one other run.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from fdi_torch.estimate.proportion import wilson
from fdi_torch.monitor.detection import CHARTS, Detector, make_detector
from fdi_torch.monitor.monitor import Monitor
from fdi_torch.monitor.monitor_settings import MonitorSettings
from fdi_torch.monitor.monte_carlo.isolation_plan import confusions, isolate_run
from fdi_torch.monitor.monte_carlo.simulated_runs import (
    FaultSchedule,
    Numbers,
    SimulatedRig,
    Task,
    fault_free_schedule,
    quantiles,
    seeded_generator,
)
from fdi_torch.monitor.noise_model import NoiseModel, learn_noise
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.whitening import Whitening
from fdi_torch.quantities import significant
from fdi_torch.tables import Table


def detectors(every: float, sampling: float, channels: int, learnt: Whitening | None = None) -> list[Detector]:
    """One detector of each kind, all with the mean time `every` s between false alarms."""
    return [make_detector(chart, every, sampling, channels, torch.Generator(), learnt=learnt) for chart in CHARTS]


def white_residuals(rig: SimulatedRig, noise: NoiseModel, samples: Samples) -> Tensor:
    """White residuals (R, S, sensors) of an observer with nominal parameters, started at the equilibrium."""
    seen = Observer(rig.network, noise.gain).run(samples, rig.levels)
    return noise.whitening(seen.steady_residual)


@dataclass(frozen=True)
class Delays:
    """delay (R,) s from onset to the first alarm, infinite if there is none; early (R,) bool: whether there was a false
    alarm before the onset, after which the detector restarts.
    """

    chart: str
    delay: Tensor
    early: Tensor


def delays(
    rig: SimulatedRig, noise: NoiseModel, charts: Sequence[Detector], samples: Samples, schedule: FaultSchedule
) -> list[Delays]:
    """Detection delay of each detector."""
    white = white_residuals(rig, noise, samples)
    results = []
    for detector in charts:
        alarms, before = detector.alarms(white), samples.time < schedule.onset.unsqueeze(1)
        first = torch.where(alarms & ~before, samples.time, torch.inf).amin(dim=1)
        results.append(Delays(detector.chart, first - schedule.onset, (alarms & before).any(dim=1)))
    return results


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

    def result_table(self, numbers: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
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
        return Table(header, rows, "faults found", summary=summary if rows else "")


def _short(names: str) -> str:
    return names.replace(".size", "")


NORMAL = 1.96  # of a 95 % interval
FAULT_FREE_AT_ONCE = 250  # runs side by side
FALSE_ALARMS = "false alarms"


@dataclass(frozen=True)
class FalseAlarmPlan:
    """rigs: by the name of their noise. samples: per run. every: designed mean time between false alarms, s."""

    rigs: Mapping[str, SimulatedRig]
    runs: int
    samples: int
    calibrations: int
    every: float
    seed: int

    def tasks(self) -> list[Task]:
        """One task per calibration; each calibration has its own runs."""
        kinds = list(self.rigs)
        return [
            Task(f"{FALSE_ALARMS}/{kind}", lambda kind=kind, n=n: self._count(kind, n))  # type: ignore[misc]
            for n in range(self.calibrations)
            for kind in kinds
        ]

    def _count(self, kind: str, number: int) -> Numbers:
        rig, row = self.rigs[kind], list(self.rigs).index(kind)
        training = rig.run(fault_free_schedule(rig.space, 1), self.samples, seeded_generator(self.seed, 1, row, number))
        one = training.member(0)
        noise, _ = learn_noise(rig.network, one, levels=rig.levels)
        sensors = one.readings.shape[-1]
        charts = detectors(self.every, rig.sampling, sensors, learnt=noise.whitening)
        generator = seeded_generator(self.seed, 2, row, number)
        counts: dict[str, float | list[float] | list[str]] = {}
        seconds = self.runs * (self.samples - 1) * rig.sampling
        for first in range(0, self.runs, FAULT_FREE_AT_ONCE):
            count = min(FAULT_FREE_AT_ONCE, self.runs - first)
            white = white_residuals(rig, noise, rig.run(fault_free_schedule(rig.space, count), self.samples, generator))
            for detector in charts:
                before = counts.get(detector.chart, 0.0)
                assert isinstance(before, float)
                counts[detector.chart] = before + float(detector.alarms(white).sum())
        for detector in charts:
            interval = [float(detector.design.count_quantile(seconds, p)) for p in (0.025, 0.975)]
            counts[f"{detector.chart} interval"] = interval
        return {**counts, "expected": seconds / self.every}

    def result_table(self, numbers: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
        """Achieved and designed mean times, for all calibrations together and their range."""
        rows, agreeing, total = [], 0, 0
        for kind in self.rigs:
            results = numbers.get(f"{FALSE_ALARMS}/{kind}", ())
            for chart in CHARTS if results else ():
                counts, expected = [int(n[chart]) for n in results], float(results[0]["expected"])
                mean, low, high = mean_time(counts, self.every, expected)
                single = [self.every * expected / max(c, 1) for c in (max(counts), min(counts))]
                alarms = f"{sum(counts)} ({expected * len(counts):.0f})"
                words = (f"{mean:.0f}", f"{low:.0f} … {high:.0f}", f"{single[0]:.0f} … {single[1]:.0f}")
                intervals = [n[f"{chart} interval"] for n in results]
                within = sum(low <= c <= high for c, (low, high) in zip(counts, intervals, strict=True))
                rows.append((kind, chart, str(len(counts)), alarms, *words, f"{within} of {len(counts)}"))
                agreeing, total = agreeing + within, total + len(counts)
        what = ("noise", "detector", "calibrations", "alarms (asked)")
        header = (*what, "time between, s", "95 %", "single calibrations, s", "within own 95 %")
        summary = f"{agreeing} of {total} calibrations alarm falsely as often as they predict" if total else ""
        return Table(header, rows, f"false alarms; configured: one in {significant(self.every, 3)} s", summary=summary)


def mean_time(counts: Sequence[int], every: float, expected: float) -> tuple[float, float, float]:
    """Mean time between false alarms over calibrations, s, and its 95 % interval.

    The interval uses the scatter of the counts, which has a random part and one from calibration, and at least the
    Poisson variance.
    """
    from scipy.special import (
        stdtrit,  # Student's t; imported here because the import takes a tenth of a second
    )

    mean, error = statistics.fmean(counts), NORMAL * statistics.fmean(counts) ** 0.5
    if len(counts) > 1:
        error = max(error, float(stdtrit(len(counts) - 1, 0.975)) * statistics.stdev(counts))
    error /= len(counts) ** 0.5
    mean = max(mean, 0.5)
    return every * expected / mean, every * expected / (mean + error), every * expected / max(mean - error, 0.5)
