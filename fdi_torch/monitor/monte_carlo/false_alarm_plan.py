"""Monte Carlo plan: false alarms of each detector when its noise model was learnt from one other run."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fdi_torch.monitor.detection import CHARTS
from fdi_torch.monitor.monte_carlo.detector_trials import detectors, white_residuals
from fdi_torch.monitor.monte_carlo.simulated_runs import SimulatedRig, fault_free_schedule
from fdi_torch.monitor.monte_carlo.tasks import Numbers, ResultTable, Task, seeded_generator
from fdi_torch.monitor.noise_model import learn_noise
from fdi_torch.quantities import significant

NORMAL = 1.96  # of a 95 % interval
RUNS_AT_ONCE = 250  # runs side by side
NAME = "false alarms"


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
            Task(f"{NAME}/{kind}", lambda kind=kind, n=n: self._count(kind, n))  # type: ignore[misc]
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
        for first in range(0, self.runs, RUNS_AT_ONCE):
            count = min(RUNS_AT_ONCE, self.runs - first)
            white = white_residuals(rig, noise, rig.run(fault_free_schedule(rig.space, count), self.samples, generator))
            for detector in charts:
                before = counts.get(detector.chart, 0.0)
                assert isinstance(before, float)
                counts[detector.chart] = before + float(detector.alarms(white).sum())
        for detector in charts:
            interval = [float(detector.design.count_quantile(seconds, p)) for p in (0.025, 0.975)]
            counts[f"{detector.chart} interval"] = interval
        return {**counts, "expected": seconds / self.every}

    def result_table(self, numbers: Mapping[str, Sequence[Mapping[str, Any]]]) -> ResultTable:
        """Achieved and designed mean times, for all calibrations together and their range."""
        rows, agreeing, total = [], 0, 0
        for kind in self.rigs:
            results = numbers.get(f"{NAME}/{kind}", ())
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
        return ResultTable(
            f"false alarms; configured: one in {significant(self.every, 3)} s", header, tuple(rows), summary
        )


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
