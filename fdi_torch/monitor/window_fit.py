"""Parameters from one window of readings, by any of several estimators: the search of (16) and its rivals.

All take the same window and the last estimate, and work on many runs side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.diagnosis import sample_noise
from fdi_torch.estimate.draws import problem_seeds
from fdi_torch.estimate.evolution import evolve
from fdi_torch.estimate.evolution_settings import EvolutionSettings
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.objectives import Objective, Problem, Term, spread_of
from fdi_torch.plant.scales import time_scale
from fdi_torch.simulate.engine import Readings

# Steps of the search and of the refinement, in units of the plant's time scale: a window's worth of error is far below
# noise of 30 dB.
SEARCH_STEP, REFINE_STEP = 5.0, 0.5
SEARCH = EvolutionSettings(population=40, evaluations=2000)
REFINE = RefineSettings(iterations=60, decrease_tolerance=1e-6)
STARTS = 8  # of the multi-start refinement, beside the last estimate
# Of the search's members, how many are refined; members closer than this share of the box are one.
REFINED, APART = 3, 0.05
# A channel whose spread is less than this many times its sample-to-sample noise stands still.
STILL_RATIO = 1.2


@dataclass(frozen=True)
class WindowData:
    """fitting: plant and inputs of the window, faults first. readings (R, S, C) of R runs, std (R, C) of their noise
    where it is known.
    """

    fitting: Fitting
    readings: Tensor
    std: Tensor | None = None

    @property
    def runs(self) -> int:
        return len(self.readings)

    @property
    def box(self) -> tuple[Tensor, Tensor]:
        """low, high (R, P)."""
        space = self.fitting.space
        return space.low().expand(self.runs, -1), space.high().expand(self.runs, -1)

    @property
    def data(self) -> Readings:
        return Readings(torch.nan_to_num(self.readings), torch.isfinite(self.readings).to(self.readings.dtype))

    def problem(self, step: float, objective: Objective) -> Problem:
        std = self.std if objective == "likelihood" else None
        return Problem(self.fitting.space, [Term(self.fitting.engines(step)[0], self.data, None, std)], objective)

    def moves(self) -> bool:
        """Whether every channel of every run varies by more than its own noise, so that correlations say something."""
        data = self.data
        spread = torch.sqrt(spread_of(data) / data.count.clamp(min=1.0))
        own = [sample_noise(values, weight) for values, weight in zip(data.values, data.weight, strict=True)]
        return bool((spread > STILL_RATIO * torch.stack(own)).all())


@dataclass(frozen=True)
class WindowEstimate:
    """value and std (R, P); std infinite where nothing determines a parameter, NaN where the method gives none."""

    value: Tensor
    std: Tensor


Estimator = Callable[[WindowData, Tensor, int], WindowEstimate]
"""(window, last estimate (R, P), seed) -> estimate of each run."""


def evolution(window: WindowData, before: Tensor, seed: int) -> WindowEstimate:
    """Differential evolution on the sum of correlations, warm from the last estimate (2020 paper, eq. 16)."""
    members, _ = _searched(window, before, seed)
    return WindowEstimate(members[:, 0], torch.full_like(before, torch.nan))


def hybrid(window: WindowData, before: Tensor, seed: int) -> WindowEstimate:
    """The same search, its best and mutually distant members and the last estimate refined on the likelihood."""
    members, _ = _searched(window, before, seed)
    return _refined(window, torch.cat([members, before.unsqueeze(1)], dim=1))


def least_squares(window: WindowData, before: Tensor, seed: int) -> WindowEstimate:
    """Levenberg-Marquardt on the likelihood, from the last estimate alone."""
    return _refined(window, before.unsqueeze(1))


def multi_start(window: WindowData, before: Tensor, seed: int) -> WindowEstimate:
    """Levenberg-Marquardt from the last estimate and from points drawn in the box: global without evolution."""
    low, high = window.box
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(window.runs, STARTS, before.shape[1], generator=generator, dtype=before.dtype)
    starts = low.unsqueeze(1) + drawn * (high - low).unsqueeze(1)
    return _refined(window, torch.cat([starts, before.unsqueeze(1)], dim=1))


ESTIMATORS: dict[str, Estimator] = {
    "hybrid": hybrid,
    "evolution": evolution,
    "least_squares": least_squares,
    "multi_start": multi_start,
}


def _searched(window: WindowData, before: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Mutually distant members (R, K, P), the best first, and the best cost (R,)."""
    low, high = window.box
    objective: Objective = "correlation" if window.moves() else "likelihood"
    span = float(window.fitting.recordings[0].time[-1] - window.fitting.recordings[0].time[0])
    longest = SEARCH_STEP * time_scale(window.fitting.plant)
    problem = window.problem(min(longest, span / 20.0), objective)
    seeds = problem_seeds(seed, (window.runs,), low.device)
    found = evolve(problem.cost, low, high, SEARCH, seeds, first_guess=before.clamp(low, high).unsqueeze(1))
    return _distant(found.population, found.cost, (high - low)[0]), found.best_cost


def _distant(population: Tensor, cost: Tensor, width: Tensor) -> Tensor:
    """The best member of each population (R, N, P), best first, and the next best apart from those taken."""
    usable = torch.isfinite(cost) & torch.isfinite(population).all(-1)
    taken = [population[:, 0]]
    for _ in range(REFINED - 1):
        near = torch.stack([((population - t[:, None]) / width).abs().amax(-1) <= APART for t in taken]).any(0)
        fits = usable & ~near
        place = fits.to(torch.int8).argmax(-1)
        following = population[torch.arange(len(population)), place]
        taken.append(torch.where(fits.any(-1)[:, None], following, taken[0]))
    return torch.stack(taken, dim=1)


def _refined(window: WindowData, starts: Tensor) -> WindowEstimate:
    """The best of the refinements from every start (R, K, P)."""
    each, (low, high) = starts.shape[1], window.box
    problem = window.problem(REFINE_STEP * time_scale(window.fitting.plant), "likelihood")
    refined = levenberg_marquardt(
        lambda theta, members: problem.linearise(theta, members // each),
        starts,
        low.unsqueeze(1),
        high.unsqueeze(1),
        REFINE,
    )
    cost = torch.where(torch.isfinite(refined.cost), refined.cost, torch.inf)
    rows, best = torch.arange(window.runs), cost.argmin(-1)
    assert refined.curvature is not None
    held = None if refined.held is None else refined.held[rows, best]
    return WindowEstimate(refined.theta[rows, best], certainty(refined.curvature[rows, best], held=held).std)


def cut(fitting: Fitting, samples: int) -> Fitting:
    """The same on the first samples of its recording."""
    return replace(fitting, recordings=(fitting.recordings[0].stretch(0, samples),))
