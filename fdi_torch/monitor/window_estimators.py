"""Parameter estimators for one window of readings: the search of the 2020 paper (eq. 16), and least squares.

Both take a window and the previous estimate, and process a batch of runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.draws import problem_seeds
from fdi_torch.estimate.evolution import evolve
from fdi_torch.estimate.evolution_settings import EvolutionSettings
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.information import certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.objectives import Objective, Problem, Term, spread_of
from fdi_torch.plant.scales import time_scale
from fdi_torch.sample_noise import sample_noise
from fdi_torch.simulate.engine import Readings

# Integration steps of search and refinement, in units of the plant's time scale; their error over a window is far below
# measurement noise of 30 dB.
SEARCH_STEP, REFINE_STEP = 5.0, 0.5
SEARCH = EvolutionSettings(population=40, evaluations=2000)
REFINE = RefineSettings(iterations=60, decrease_tolerance=1e-6)
# A channel is constant if its standard deviation is less than this multiple of its sample-to-sample noise.
CONSTANT_RATIO = 1.2


@dataclass(frozen=True)
class WindowData:
    """fitting: of a window, faults first. readings (R, S, C): of R runs; std (R, C): their noise if known."""

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
        """Whether every channel of every run varies by more than its noise, so that its correlation is defined."""
        data = self.data
        std = torch.sqrt(spread_of(data) / data.count.clamp(min=1.0))
        noise = [sample_noise(values, weight) for values, weight in zip(data.values, data.weight, strict=True)]
        return bool((std > CONSTANT_RATIO * torch.stack(noise)).all())


@dataclass(frozen=True)
class WindowEstimate:
    """value and std (R, P); std is infinite for an undetermined parameter, NaN if the method gives none."""

    value: Tensor
    std: Tensor


Estimator = Callable[[WindowData, Tensor, int], WindowEstimate]
"""(window, previous estimate (R, P), seed) -> estimate of each run."""


def evolution(window: WindowData, before: Tensor, seed: int) -> WindowEstimate:
    """Differential evolution on the sum of correlations, started at the previous estimate (2020 paper, eq. 16)."""
    low, high = window.box
    objective: Objective = "correlation" if window.moves() else "likelihood"
    span = float(window.fitting.recordings[0].time[-1] - window.fitting.recordings[0].time[0])
    longest = SEARCH_STEP * time_scale(window.fitting.plant)
    problem = window.problem(min(longest, span / 20.0), objective)
    seeds = problem_seeds(seed, (window.runs,), low.device)
    result = evolve(problem.cost, low, high, SEARCH, seeds, first_guess=before.clamp(low, high).unsqueeze(1))
    return WindowEstimate(result.population[:, 0], torch.full_like(before, torch.nan))


def least_squares(window: WindowData, before: Tensor, seed: int) -> WindowEstimate:
    """Levenberg-Marquardt on the likelihood, from the previous estimate."""
    problem = window.problem(REFINE_STEP * time_scale(window.fitting.plant), "likelihood")
    refined = levenberg_marquardt(problem.linearise, before, *window.box, REFINE)
    assert refined.curvature is not None
    return WindowEstimate(refined.theta, certainty(refined.curvature, held=refined.held).std)


ESTIMATORS: dict[str, Estimator] = {"evolution": evolution, "least_squares": least_squares}
