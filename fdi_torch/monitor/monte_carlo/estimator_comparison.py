"""Comparison of on-line estimators on random multiple faults: error over its bound, failures, speed and cost."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.information import certainty, fisher_information
from fdi_torch.monitor.adaptive_observer import LEVEL_NOISE, JointModel, adaptive_gain, adaptive_observer, joint_filter
from fdi_torch.monitor.monte_carlo.tasks import Numbers, ResultTable, Task, quantiles, seeded_generator
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.window_estimators import ESTIMATORS, WindowData
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.scales import length_scale
from fdi_torch.simulate.simulated_recording import noise_level

NAME = "rivals"
# Integration step (s) of the data and of the bounds: fine, so that no estimator has the same discretization error.
DATA_STEP = 0.05
FILTERS = ("kalman", "adaptive")
ESTIMATOR_NAMES = (*ESTIMATORS, *FILTERS)
# A fault's size is drawn between these shares of the distance from nominal to the far end of its range.
SMALLEST, LARGEST = 0.1, 0.7
CLOSE = 0.05  # share of a parameter's range: "within 5 %"
FAR = 5.0  # multiples of the bound; an estimate that is farther off and not close is a failure
START_STD = 1e-4  # standard deviation of an initial level, in units of the plant's length scale


@dataclass(frozen=True)
class RandomFaultRuns:
    """R runs that are faulty from their start.

    truth (R, P); faulty (R, P) bool; readings (R, S, C) with noise std (R, C); bound (R, P): Cramer-Rao bound of whole
    runs with known initial levels and noise.
    """

    fitting: Fitting
    truth: Tensor
    faulty: Tensor
    readings: Tensor
    std: Tensor
    bound: Tensor

    @property
    def samples(self) -> Samples:
        recording = self.fitting.recordings[0]
        return Samples(recording.time, recording.inputs, self.readings, recording.hold)


@dataclass(frozen=True)
class EstimateTracks:
    """Estimates (R, K, P) after `sample_counts` (K,) samples, and CPU seconds per run and sample."""

    sample_counts: Tensor
    theta: Tensor
    cost: float


@dataclass(frozen=True)
class ComparisonRow:
    """Performance of one estimator.

    over_bound: root mean square of error / bound over the faulty parameters of successful runs, and its 95 % interval.
    failures: number of the `runs` whose final errors exceed both 5 % of the range and five bounds. never: number of
    runs that did not stay within 5 %.
    to_close: quartiles of the time after which all parameters stay within 5 % of their range, s; infinite: never.
    """

    name: str
    snr_db: float
    runs: int
    over_bound: float
    interval: tuple[float, float]
    failures: int
    never: int
    to_close: tuple[float, float, float]
    cost: float


def draw_runs(fitting: Fitting, count: int, snr_db: float, generator: torch.Generator) -> RandomFaultRuns:
    """Random sets of 1 to P faults of random sizes, read with noise of the given SNR (against variance)."""
    space = fitting.space
    parameters = len(space)
    rank = torch.rand(count, parameters, generator=generator, dtype=torch.float64).argsort(1).argsort(1)
    size = torch.randint(1, parameters + 1, (count, 1), generator=generator)
    faulty = rank < size
    nominal = space.nominal()
    far = torch.where((space.high() - nominal).abs() >= (nominal - space.low()).abs(), space.high(), space.low())
    share = SMALLEST + (LARGEST - SMALLEST) * torch.rand(count, parameters, generator=generator, dtype=torch.float64)
    truth = torch.where(faulty, nominal + share * (far - nominal), nominal)
    readings, bounds, stds = [], [], []
    engine = fitting.engines(DATA_STEP)[0]
    for part in truth.split(25):
        clean, jacobian = engine.linearise(part)
        std = noise_level(clean, snr_db)
        readings.append(clean + std.unsqueeze(1) * torch.randn(clean.shape, generator=generator, dtype=clean.dtype))
        bounds.append(certainty(fisher_information(jacobian, std)).std)
        stds.append(std)
    return RandomFaultRuns(fitting, truth, faulty, torch.cat(readings), torch.cat(stds), torch.cat(bounds))


def track_estimates(name: str, runs: RandomFaultRuns, sample_counts: Sequence[int]) -> EstimateTracks:
    """The estimates of one estimator. Raises ValueError for an unknown name."""
    if name not in ESTIMATOR_NAMES:
        raise ValueError(f"expected an estimator of {', '.join(ESTIMATOR_NAMES)}, got '{name}'")
    started = time.process_time()
    theta = _filtered(name, runs, sample_counts) if name in FILTERS else _in_windows(name, runs, sample_counts)
    seconds = time.process_time() - started
    return EstimateTracks(torch.tensor(sample_counts), theta, seconds / (len(runs.truth) * runs.readings.shape[1]))


def comparison_row(name: str, snr_db: float, runs: RandomFaultRuns, tracks: EstimateTracks) -> ComparisonRow:
    """Summarise the tracks of one estimator."""
    space = runs.fitting.space
    deviation = (tracks.theta - runs.truth.unsqueeze(1)).abs()
    near = (deviation <= CLOSE * (space.high() - space.low())).all(-1)  # (R, K)
    final = deviation[:, -1] / runs.bound
    failed = ~near[:, -1] & (final > FAR).any(-1)
    failed |= ~torch.isfinite(tracks.theta[:, -1]).all(-1)
    counted = runs.faulty & ~failed.unsqueeze(1) & torch.isfinite(runs.bound)
    ratios = final[counted].square()
    mean, error = float(ratios.mean()), float(ratios.std()) / max(len(ratios), 1) ** 0.5
    low, high = (max(mean + sign * 1.96 * error, 0.0) ** 0.5 for sign in (-1.0, 1.0))
    stays = _from_now_on(near)
    first = torch.where(stays.any(1), stays.to(torch.int8).argmax(1), -1)
    step = float(torch.diff(runs.samples.time).median())
    times = torch.where(first >= 0, step * tracks.sample_counts[first].to(torch.float64), torch.inf)
    low_quarter, middle, high_quarter = quantiles(times.tolist(), (0.25, 0.5, 0.75))
    return ComparisonRow(
        name, snr_db, len(failed), mean**0.5, (low, high), int(failed.sum()), int((first < 0).sum()),
        (low_quarter, middle, high_quarter), tracks.cost,
    )  # fmt: skip


def _from_now_on(near: Tensor) -> Tensor:
    """(R, K) bool: close at this and all later estimates."""
    return near.to(torch.int8).flip(1).cummin(1).values.flip(1).to(torch.bool)


def _in_windows(name: str, runs: RandomFaultRuns, sample_counts: Sequence[int]) -> Tensor:
    """Estimates from growing windows since the start of the run, each started at the previous estimate."""
    estimator, estimates = ESTIMATORS[name], []
    before = runs.fitting.space.nominal().expand(len(runs.truth), -1)
    for number, last in enumerate(sample_counts):
        seen = replace(runs.fitting, recordings=(runs.fitting.recordings[0].stretch(0, last + 1),))
        window = WindowData(seen, runs.readings[:, : last + 1], runs.std)
        before = estimator(window, before, number).value
        estimates.append(before)
    return torch.stack(estimates, dim=1)


def _filtered(name: str, runs: RandomFaultRuns, sample_counts: Sequence[int]) -> Tensor:
    """Estimates of a filter, which knows the noise and the initial uncertainty of the parameters."""
    fitting = runs.fitting
    network, space = fitting.networks[0], fitting.space
    model, count = JointModel(network, space), len(runs.truth)
    start = torch.tensor([t.start_level for t in network.description.tanks], dtype=torch.float64)
    noise = runs.std.square().mean(0).sqrt()
    initial_std = _initial_std(space)
    levels, theta = start.expand(count, -1), space.nominal().expand(count, -1)
    if name == "kalman":
        length = length_scale(network.description)
        start_std = torch.cat([torch.full_like(start, START_STD * length), initial_std])
        wander = torch.cat([torch.full_like(start, LEVEL_NOISE * length), 1e-4 * initial_std])
        run = joint_filter(model, runs.samples, levels, theta, start_std, wander, runs.std)
    else:
        gain, rate = adaptive_gain(model, runs.samples, start, space.nominal(), 3e-2 * initial_std, noise)
        run = adaptive_observer(model, runs.samples, levels, theta, gain, rate)
    return run.theta[:, list(sample_counts)]


def _initial_std(space: ParameterSpace) -> Tensor:
    """Initial standard deviation of the parameters, (P,): a third of their range."""
    return (space.high() - space.low()) / 3.0


@dataclass(frozen=True)
class EstimatorComparisonPlan:
    """Monte Carlo plan: `sets` random fault sets, `subset` of them per task. looks: numbers of samples after which all
    estimate.
    """

    fitting: Fitting
    sets: int
    subset: int
    snr_db: tuple[float, ...]
    looks: tuple[int, ...]
    seed: int
    rivals: tuple[str, ...] = ESTIMATOR_NAMES

    def tasks(self) -> list[Task]:
        return [
            Task(f"{NAME}/{snr:g}/{rival}", lambda s=snr, r=rival, f=first: self._track(s, r, f))  # type: ignore[misc]
            for snr in self.snr_db
            for rival in self.rivals
            for first in range(0, self.sets, self.subset)
        ]

    def _track(self, snr: float, rival: str, first: int) -> Numbers:
        tracks = track_estimates(rival, self._runs(snr, first), self.looks)
        return {"theta": tracks.theta.flatten().tolist(), "cost": tracks.cost, "first": float(first)}

    @lru_cache(maxsize=4)  # noqa: B019 - a plan lives as long as the program
    def _runs(self, snr: float, first: int) -> RandomFaultRuns:
        count = min(self.subset, self.sets - first)
        return draw_runs(self.fitting, count, snr, seeded_generator(self.seed, 9, int(snr), first))

    def result_table(self, numbers: Mapping[str, Sequence[Mapping[str, Any]]]) -> ResultTable:
        rows = []
        for snr in self.snr_db:
            for rival in self.rivals:
                results = numbers.get(f"{NAME}/{snr:g}/{rival}", ())
                if results:
                    rows.append(self._row(snr, rival, results))
        what = ("SNR, dB", "rival", "sets", "error / bound", "95 %", "failures", "never within 5 %")
        times = ("to within 5 %, s (quartiles)", "CPU ms a sample")
        nearest = min(rows, key=lambda row: float(row[3]), default=None)
        summary = f"{nearest[1]} comes nearest to the bound ({nearest[3]} times it)" if nearest else ""
        return ResultTable("rivals on random sets of faults", (*what, *times), tuple(rows), summary)

    def _row(self, snr: float, rival: str, results: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
        width = len(self.fitting.space)
        parts = [self._runs(snr, int(n["first"])) for n in results]
        theta = torch.cat(
            [torch.tensor(n["theta"], dtype=torch.float64).reshape(-1, len(self.looks), width) for n in results]
        )
        fields = ("truth", "faulty", "readings", "std", "bound")
        runs = RandomFaultRuns(self.fitting, *(torch.cat([getattr(p, field) for p in parts]) for field in fields))
        cost = sum(n["cost"] for n in results) / len(results)
        row = comparison_row(rival, snr, runs, EstimateTracks(torch.tensor(self.looks), theta, cost))
        quarter = [f"{t:.0f}" if t < 1e9 else "never" for t in row.to_close]
        ratio = (f"{row.over_bound:.2f}", f"{row.interval[0]:.2f} .. {row.interval[1]:.2f}")
        ends = (str(row.failures), str(row.never), f"{quarter[1]} ({quarter[0]} .. {quarter[2]})")
        return (f"{snr:g}", rival, str(row.runs), *ratio, *ends, f"{1e3 * row.cost:.3g}")
