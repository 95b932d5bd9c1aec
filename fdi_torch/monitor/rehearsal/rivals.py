"""On-line estimators side by side on random multiple faults: error against its bound, failures, speed, cost."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.information import certainty, fisher_information
from fdi_torch.monitor.adaptive import WANDER, JointModel, adaptive_observer, designed_rate, joint_filter
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.window_fit import ESTIMATORS, WindowData, cut
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.scales import length_scale
from fdi_torch.simulate.simulated_recording import noise_level

# Integration steps (s) of the data, and of the bounds: fine, so that their error is nobody's.
DATA_STEP = 0.05
FILTERS = ("kalman", "adaptive")
RIVALS = (*ESTIMATORS, *FILTERS)
# A fault's size is drawn between these shares of the way from nominal to the far end of its range.
SMALLEST, LARGEST = 0.1, 0.7
CLOSE = 0.05  # of a parameter's range: "to 5 %"
FAR = 5.0  # bounds; what is further and not close is a failure
START_STD = 1e-4  # of a level before the first reading, in units of the plant's length scale


@dataclass(frozen=True)
class Runs:
    """R runs, faulty from their beginning: truth (R, P), which is faulty (R, P) bool, readings (R, S, C), std (R, C) of
    their noise, and the Cramer-Rao bound (R, P) for whole runs with start levels and noise level known.
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
class Tracked:
    """Estimates (R, K, P) at `looks` (K,) samples after the beginning, and CPU seconds of a run and sample."""

    looks: Tensor
    theta: Tensor
    cost: float


@dataclass(frozen=True)
class Row:
    """What one rival did. over_bound: root mean square of (error / bound) over the faulty parameters of runs that did
    not fail, and its 95 % interval. failures: runs that ended neither close nor within five bounds, of `runs`.
    to_close: quartiles of the time from which on all parameters stay within 5 % of their range, s; infinite: never.
    """

    rival: str
    snr_db: float
    runs: int
    over_bound: float
    interval: tuple[float, float]
    failures: int
    never: int
    to_close: tuple[float, float, float]
    cost: float


def draw_runs(fitting: Fitting, count: int, snr_db: float, generator: torch.Generator) -> Runs:
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
    return Runs(fitting, truth, faulty, torch.cat(readings), torch.cat(stds), torch.cat(bounds))


def compare(runs: Runs, snr_db: float, looks: Sequence[int], rivals: Sequence[str] = RIVALS) -> Iterator[Row]:
    """One row for each rival, as soon as it is done."""
    for rival in rivals:
        yield judged(rival, snr_db, runs, track(rival, runs, looks))


def track(rival: str, runs: Runs, looks: Sequence[int]) -> Tracked:
    """The estimates of one rival. Raises ValueError for a rival that is not known."""
    if rival not in RIVALS:
        raise ValueError(f"expected a rival of {', '.join(RIVALS)}, got '{rival}'")
    began = time.process_time()
    theta = _filtered(rival, runs, looks) if rival in FILTERS else _in_windows(rival, runs, looks)
    spent = time.process_time() - began
    return Tracked(torch.tensor(looks), theta, spent / (len(runs.truth) * runs.readings.shape[1]))


def judged(rival: str, snr_db: float, runs: Runs, tracked: Tracked) -> Row:
    """The table's row."""
    space = runs.fitting.space
    error = (tracked.theta - runs.truth.unsqueeze(1)).abs()
    near = (error <= CLOSE * (space.high() - space.low())).all(-1)  # (R, K)
    final = error[:, -1] / runs.bound
    failed = ~near[:, -1] & (final > FAR).any(-1)
    failed |= ~torch.isfinite(tracked.theta[:, -1]).all(-1)
    counted = runs.faulty & ~failed.unsqueeze(1) & torch.isfinite(runs.bound)
    ratios = final[counted].square()
    mean, spread = float(ratios.mean()), float(ratios.std()) / max(len(ratios), 1) ** 0.5
    low, high = (max(mean + sign * 1.96 * spread, 0.0) ** 0.5 for sign in (-1.0, 1.0))
    # From the last look that was not close on: the next one.
    stays = _from_here_on(near)
    first = torch.where(stays.any(1), stays.to(torch.int8).argmax(1), -1)
    step = float(torch.diff(runs.samples.time).median())
    moments = torch.where(first >= 0, step * tracked.looks[first].to(torch.float64), torch.inf)
    order = moments.sort().values
    quartiles = tuple(float(order[min(int(q * len(order)), len(order) - 1)]) for q in (0.25, 0.5, 0.75))
    return Row(
        rival, snr_db, len(failed), mean**0.5, (low, high), int(failed.sum()), int((first < 0).sum()),
        (quartiles[0], quartiles[1], quartiles[2]), tracked.cost,
    )  # fmt: skip


def _from_here_on(near: Tensor) -> Tensor:
    """(R, K) bool: close at this look and at all later ones."""
    return near.to(torch.int8).flip(1).cummin(1).values.flip(1).to(torch.bool)


def _in_windows(rival: str, runs: Runs, looks: Sequence[int]) -> Tensor:
    """A window from the fault on, each look with what it found at the one before."""
    estimator, found = ESTIMATORS[rival], []
    before = runs.fitting.space.nominal().expand(len(runs.truth), -1)
    for number, look in enumerate(looks):
        window = WindowData(cut(runs.fitting, look + 1), runs.readings[:, : look + 1], runs.std)
        before = estimator(window, before, number).value
        found.append(before)
    return torch.stack(found, dim=1)


def _filtered(rival: str, runs: Runs, looks: Sequence[int]) -> Tensor:
    """Sample by sample; the filters know the noise, and how far parameters may be off at first."""
    fitting = runs.fitting
    network, space = fitting.networks[0], fitting.space
    model, count = JointModel(network, space), len(runs.truth)
    start = torch.tensor([t.start_level for t in network.description.tanks], dtype=torch.float64)
    noise = runs.std.square().mean(0).sqrt()
    spread = _spread(space)
    levels, theta = start.expand(count, -1), space.nominal().expand(count, -1)
    if rival == "kalman":
        length = length_scale(network.description)
        start_std = torch.cat([torch.full_like(start, START_STD * length), spread])
        wander = torch.cat([torch.full_like(start, WANDER * length), 1e-4 * spread])
        seen = joint_filter(model, runs.samples, levels, theta, start_std, wander, runs.std)
    else:
        gain, rate = designed_rate(model, runs.samples, start, space.nominal(), 3e-2 * spread, noise)
        seen = adaptive_observer(model, runs.samples, levels, theta, gain, rate)
    return seen.theta[:, list(looks)]


def _spread(space: ParameterSpace) -> Tensor:
    """How far a parameter may be off, (P,): a third of its range."""
    return (space.high() - space.low()) / 3.0
