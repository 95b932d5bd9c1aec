"""Alarms on simulated runs: how often without a fault, how soon with one, how many are missed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from fdi_torch.monitor.detection import CHARTS, LONGEST_WINDOW, NEVER, Detector, glr, make_detector, window_lengths
from fdi_torch.monitor.noise import Noise
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.rehearsal.runs import Course, Rig, fault_free
from fdi_torch.monitor.run_length import highest
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.whitening import Whitening


def detectors(
    every: float, sampling: float, channels: int, seed: int = 0, learnt: Whitening | None = None
) -> list[Detector]:
    """One of each kind, for the same mean time between false alarms, s."""
    peaks = _peaks(channels, seed)
    return [
        make_detector(chart, every, sampling, channels, torch.Generator(), learnt=learnt, peaks=peaks)
        for chart in CHARTS
    ]


@lru_cache(maxsize=8)
def _peaks(channels: int, seed: int) -> Tensor:
    """What the threshold of the GLR is simulated from, once for many detectors."""
    lengths = window_lengths(LONGEST_WINDOW)
    return highest(lambda white: glr(white, lengths), channels, torch.Generator().manual_seed(seed))


def white_residuals(rig: Rig, noise: Noise, samples: Samples) -> Tensor:
    """White residuals (R, S, sensors) of an observer that believes in no fault; it starts from rest."""
    seen = Observer(rig.network, noise.gain).run(samples, rig.levels)
    return noise.whitening(seen.steady_residual)


@dataclass(frozen=True)
class FalseAlarms:
    """counted: alarms in `seconds` s of fault-free runs; expected: as asked for."""

    chart: str
    counted: int
    expected: float
    seconds: float


def count_false_alarms(
    rig: Rig,
    noise: Noise,
    charts: Sequence[Detector],
    every: float,
    runs: int,
    samples: int,
    generator: torch.Generator,
) -> list[FalseAlarms]:
    """Alarms of each detector in so many fault-free runs. every: s between false alarms, as asked for."""
    seen = rig.run(fault_free(rig.space, runs), samples, generator)
    white = white_residuals(rig, noise, seen)
    seconds = runs * (samples - 1) * rig.sampling
    return [FalseAlarms(d.chart, int(d.alarms(white).sum()), seconds / every, seconds) for d in charts]


@dataclass(frozen=True)
class Delays:
    """alarm (R,) s of the first alarm after the onset, infinite for none within the run; early (R,) bool: a false alarm
    came before the onset; the detector then starts afresh.
    """

    chart: str
    delay: Tensor
    early: Tensor

    def quantile(self, q: float) -> float:
        """Of the delay, missed ones counted as infinite, s."""
        order = self.delay.sort().values
        return float(order[min(int(q * len(order)), len(order) - 1)])

    def missed(self) -> int:
        return int(torch.isinf(self.delay).sum())


def delays(rig: Rig, noise: Noise, charts: Sequence[Detector], samples: Samples, course: Course) -> list[Delays]:
    """How soon each detector raises an alarm."""
    white = white_residuals(rig, noise, samples)
    found = []
    for detector in charts:
        since = (samples.time < course.onset.unsqueeze(1)).sum(1)
        first, early = detector.first_from(white, since)
        when = torch.where(first == NEVER, torch.inf, samples.time[first.clamp(min=0)])
        found.append(Delays(detector.chart, when - course.onset, early > 0))
    return found
