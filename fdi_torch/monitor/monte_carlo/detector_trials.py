"""Alarms of detectors on simulated runs: rate of false alarms, detection delays and missed faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.monitor.detection import CHARTS, Detector, make_detector
from fdi_torch.monitor.monte_carlo.simulated_runs import FaultSchedule, SimulatedRig
from fdi_torch.monitor.noise_model import NoiseModel
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.whitening import Whitening


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
