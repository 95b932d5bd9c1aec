"""False alarms of single calibrations on disturbed tanks without a fault: `python -m benchmarks.monitor_false_alarms`.

Each calibration learns from its own recording and is tested on the rest of it. Its number of alarms is compared with
the 95 % interval that it states for itself: a Poisson number whose rate has the stated standard error of its logarithm.
"""

from __future__ import annotations

import argparse
import math
import time

import torch
from scipy.stats import norm, poisson

from benchmarks.monitor_rigs import KINDS, Case, recordings
from fdi_torch.config.plant_file import load_plant
from fdi_torch.monitor.detection import DRIFT, log_rate_std
from fdi_torch.monitor.fault_free_checks import QUESTION
from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.samples import samples_of_recording
from fdi_torch.recording import Recording

LEARN = (300.0, 1000.0, 3000.0)


def tested(recording: Recording, learn: float, every: float) -> tuple[int, float, bool]:
    """Alarms after the fault-free part, the stated standard error of ln(rate), and whether it is asked about."""
    plant = load_plant("three_tank")
    prepared = prepare_monitor(plant, fault_free_part(recording, 0.0, learn), time_between_false_alarms=every)
    monitor, samples = prepared.monitor, samples_of_recording(recording, plant)
    observer = Observer(
        monitor.network, prepared.noise.gain, monitor.space, prepared.believed, monitor.observer.stepper.longest
    )
    white = prepared.noise.whitening(observer.run(samples).steady_residual)[int(learn) :]
    error = log_rate_std(monitor.detector.chart, every, 3, DRIFT, prepared.noise.whitening)
    return int(monitor.detector.alarms(white).sum()), error, any(QUESTION in w for w in prepared.warnings)


def interval(expected: float, error: float) -> tuple[int, int]:
    """95 % interval of a Poisson number with a log-normal rate, by quadrature over 199 quantiles of the rate."""
    quantiles = norm.ppf((torch.arange(199) + 0.5).numpy() / 199)
    rates, low, high = expected * torch.exp(error * torch.from_numpy(quantiles)).numpy(), 0, 0
    while poisson.cdf(low, rates).mean() < 0.025:
        low += 1
    while poisson.cdf(high, rates).mean() < 0.975:
        high += 1
    return low, high


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--calibrations", type=int, default=4, help="of each kind, loop and learning time")
    parser.add_argument("--lasts", type=float, default=40000.0, help="test after learning, s")
    parser.add_argument("--every", type=float, default=20000.0)
    a = parser.parse_args()
    cells = [(k, closed, learn) for k in KINDS for closed in (True, False) for learn in LEARN]
    cases = [
        Case("", 0.0, k, learn, math.inf, learn + a.lasts, closed, 100000 * a.seed + 100 * i + j)
        for i, (k, closed, learn) in enumerate(cells)
        for j in range(a.calibrations)
    ]
    runs, started, inside, asked = recordings(cases, step=0.25), time.process_time(), 0, 0
    for first in range(0, len(cases), a.calibrations):
        case, rows = cases[first], []
        for own, (recording, _) in zip(cases[first : first + a.calibrations], runs[first:], strict=False):
            rows.append(tested(recording, own.learn, a.every))
        expected = a.lasts / a.every
        bounds = [interval(expected, error) for _, error, _ in rows]
        within = sum(low <= alarms <= high for (alarms, *_), (low, high) in zip(rows, bounds, strict=True))
        inside, asked = inside + within, asked + sum(q for *_, q in rows)
        alarms, errors = [n for n, *_ in rows], [round(e, 2) for _, e, _ in rows]
        loop = "closed" if case.closed else "open"
        print(f"{case.kind:5} {loop:6} {case.learn:5.0f} s: alarms {alarms} of {expected:g}, ", end="")
        print(f"error of ln rate {errors}, {within} of {len(rows)} within", flush=True)
    print(f"{inside} of {len(cases)} within, {asked} asked about, {time.process_time() - started:.0f} s of CPU")


if __name__ == "__main__":
    main()
