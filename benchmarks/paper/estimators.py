"""On-line estimators side by side, on random sets of one to five of the paper's faults.

`python -m benchmarks.paper.estimators` prints error over the Cramer-Rao bound, failures, speed and cost of each.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchmarks.paper.adaptive_observer import LEVEL_NOISE, JointModel, adaptive_gain, adaptive_observer, joint_filter
from benchmarks.paper.published import PARAMETERS
from fdi_torch.config.plant_file import load_plant
from fdi_torch.estimate.fitting import Fitting, set_up
from fdi_torch.estimate.information import certainty, fisher_information
from fdi_torch.monitor.monte_carlo.simulated_runs import quantiles
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.window_estimators import ESTIMATORS, WindowData
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import length_scale
from fdi_torch.recording import Recording
from fdi_torch.simulate.simulated_recording import noise_level

INPUTS = (50e-6, 50e-6)  # m^3/s
LOOKS = (30, 60, 100, 150, 200, 300, 400, 600, 800, 1000)  # numbers of samples after which all estimate
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
    failures: number of runs whose final errors exceed both 5 % of the range and five bounds. never: number of
    runs that did not stay within 5 %.
    to_close: quartiles of the time after which all parameters stay within 5 % of their range, s; infinite: never.
    """

    name: str
    over_bound: float
    interval: tuple[float, float]
    failures: int
    never: int
    to_close: tuple[float, float, float]
    cost: float

    @property
    def line(self) -> str:
        """A row of a table."""
        low, middle, high = (f"{t:.0f}" if t < 1e9 else "never" for t in self.to_close)
        error = f"{self.over_bound:.2g} ({self.interval[0]:.2g} to {self.interval[1]:.2g})"
        close = f"{middle} ({low} to {high})"
        return f"| {self.name} | {error} | {self.failures} | {self.never} | {close} | {1e3 * self.cost:.2g} ms |"


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


def comparison_row(name: str, runs: RandomFaultRuns, tracks: EstimateTracks) -> ComparisonRow:
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
        name, mean**0.5, (low, high), int(failed.sum()), int((first < 0).sum()),
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


def blank_recording(plant: PlantDescription, seconds: int) -> Recording:
    """A recording of the three tanks with constant inputs, one sample a second, without readings."""
    time = torch.arange(seconds + 1, dtype=torch.float64)
    unread = torch.full((seconds + 1, len(plant.sensors)), torch.nan, dtype=torch.float64)
    inputs = torch.tensor(INPUTS, dtype=torch.float64).expand(seconds + 1, -1)
    return plant.recording(time, inputs, unread)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sets", type=int, default=200)
    a = parser.parse_args()
    plant = load_plant("three_tank")
    fitting = set_up(plant, [blank_recording(plant, LOOKS[-1])], list(PARAMETERS), "equilibrium")
    for snr_db in (30.0, 10.0):
        runs = draw_runs(fitting, a.sets, snr_db, torch.Generator().manual_seed(a.seed))
        print(
            f"| SNR {snr_db:g} dB | error / bound | failures | never within 5 % | to within 5 %, s (quartiles) | CPU |"
        )
        print("|---|---|---|---|---|---|")
        for name in ESTIMATOR_NAMES:
            print(comparison_row(name, runs, track_estimates(name, runs, LOOKS)).line, flush=True)


if __name__ == "__main__":
    main()
