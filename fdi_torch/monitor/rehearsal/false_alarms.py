"""Rehearsal: how often each detector alarms without a fault, its noise learnt from one other run."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fdi_torch.monitor.detection import CHARTS, DRIFT, rate_error
from fdi_torch.monitor.noise import learn_noise
from fdi_torch.monitor.rehearsal.alarms import detectors, white_residuals
from fdi_torch.monitor.rehearsal.pieces import Numbers, Piece, Shown, seeded
from fdi_torch.monitor.rehearsal.runs import Rig, fault_free
from fdi_torch.monitor.samples import Samples

NORMAL = 1.96  # of a 95 % interval
PART = 250  # runs side by side
NAME = "false alarms"


@dataclass(frozen=True)
class FalseAlarmPlan:
    """rigs: by the name of their noise. samples: of each run. every: s between false alarms, as asked for."""

    rigs: Mapping[str, Rig]
    runs: int
    samples: int
    calibrations: int
    every: float
    seed: int

    def pieces(self) -> list[Piece]:
        """One for each calibration, which is held against all runs; every calibration has runs of its own."""
        kinds = list(self.rigs)
        return [
            Piece(f"{NAME}/{kind}", lambda kind=kind, n=n: self._counted(kind, n))  # type: ignore[misc]
            for n in range(self.calibrations)
            for kind in kinds
        ]

    def _counted(self, kind: str, number: int) -> Numbers:
        rig, row = self.rigs[kind], list(self.rigs).index(kind)
        learnt = rig.run(fault_free(rig.space, 1), self.samples, seeded(self.seed, 1, row, number))
        one = Samples(learnt.time, learnt.inputs, learnt.readings[0])
        noise, _ = learn_noise(rig.network, one, levels=rig.levels)
        sensors = one.readings.shape[-1]
        charts = detectors(self.every, rig.sampling, sensors, learnt=noise.whitening)
        generator = seeded(self.seed, 2, row, number)
        counts: dict[str, float | list[float] | list[str]] = {}
        for first in range(0, self.runs, PART):
            count = min(PART, self.runs - first)
            white = white_residuals(rig, noise, rig.run(fault_free(rig.space, count), self.samples, generator))
            for detector in charts:
                before = counts.get(detector.chart, 0.0)
                assert isinstance(before, float)
                counts[detector.chart] = before + float(detector.alarms(white).sum())
        for chart in CHARTS:
            run_length = self.every / rig.sampling
            counts[f"{chart} error"] = rate_error(chart, run_length, sensors, DRIFT, noise.whitening)
        return {**counts, "expected": self.runs * (self.samples - 1) * rig.sampling / self.every}

    def shown(self, found: Mapping[str, Sequence[Mapping[str, Any]]]) -> Shown:
        """Achieved over asked for mean times: of all calibrations together, and the single ones' spread."""
        rows, as_often, tried = [], 0, 0
        for kind in self.rigs:
            own = found.get(f"{NAME}/{kind}", ())
            for chart in CHARTS if own else ():
                counts, expected = [int(n[chart]) for n in own], float(own[0]["expected"])
                mean, low, high = mean_time(counts, self.every, expected)
                single = [self.every * expected / max(c, 1) for c in (max(counts), min(counts))]
                alarms = f"{sum(counts)} ({expected * len(counts):.0f})"
                words = (f"{mean:.0f}", f"{low:.0f} .. {high:.0f}", f"{single[0]:.0f} .. {single[1]:.0f}")
                errors = [float(n[f"{chart} error"]) for n in own]
                within = sum(as_asked(c, expected, error) for c, error in zip(counts, errors, strict=True))
                rows.append((kind, chart, str(len(counts)), alarms, *words, f"{within} of {len(counts)}"))
                as_often, tried = as_often + within, tried + len(counts)
        what = ("noise", "detector", "calibrations", "alarms (asked)")
        header = (*what, "s between", "95 %", "single calibrations", "within own 95 %")
        said = f"{as_often} of {tried} calibrations alarm falsely as often as asked for" if tried else ""
        return Shown(f"false alarms, {self.every:g} s between them asked for", header, tuple(rows), said)


def as_asked(count: int, expected: float, rate_error: float) -> bool:
    """Whether a count of false alarms agrees with what was asked for, to 95 %: by chance, and by how far the rate's
    logarithm is off where noise is learnt from one recording.
    """
    error = NORMAL * (rate_error**2 + 1.0 / expected) ** 0.5
    return abs(math.log(max(count, 0.5) / expected)) <= error


def mean_time(counts: Sequence[int], every: float, expected: float) -> tuple[float, float, float]:
    """Mean time between false alarms over calibrations, s, and its 95 % interval; counts vary by chance and by
    calibration, both of which their spread holds (that of Poisson counts at least).
    """
    from scipy.special import (
        stdtrit,  # Student's t; a tenth of a second, which only a finished rehearsal has to wait for
    )

    mean, error = statistics.fmean(counts), NORMAL * statistics.fmean(counts) ** 0.5
    if len(counts) > 1:
        error = max(error, float(stdtrit(len(counts) - 1, 0.975)) * statistics.stdev(counts))
    error /= len(counts) ** 0.5
    mean = max(mean, 0.5)
    return every * expected / mean, every * expected / (mean + error), every * expected / max(mean - error, 0.5)
