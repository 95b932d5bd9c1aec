"""The most likely disturbances of the flows and scales of the sensors' noise, beside parameters of the plant.

Intensities and scales maximise the likelihood of the innovations (kalman.py), whose slopes the disturbance smoother
gives (Durbin and Koopman, 2012, "Time series analysis by state space methods", section 7.3.3); linear parameters are
profiled out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from fdi_torch.estimate.kalman import KalmanFilter, Propagation, Score, SensorNoise, StateNoise

CORRELATION_TIMES = (0.0, 5.0, 20.0, 80.0, 320.0)  # candidates, in sampling intervals; 0: white
SETTLED = 0.1  # nats; a smaller gain of an iteration ends the optimisation
RIDGE = 1e-12  # of a unit curvature: parameters that nothing shows stay where they are
LEAST = 1e-2  # readings that determine a parameter, for the unit in which it is optimised
WIDEST = 10.0  # |log| of an intensity over its unit, and of a scale: bounds of the optimisation


@dataclass(frozen=True)
class Likelihood:
    """log_likelihood: of the residuals, at its maximum over the linear parameters within their priors and over the
    noise; without the constant of the normal distribution. converged: whether the optimisation of the noise ended.
    """

    noise: StateNoise
    log_likelihood: float
    converged: bool


def estimate_state_noise(
    propagation: Propagation,
    sensors: SensorNoise,
    residual: Tensor,
    jacobian: Tensor,
    pull: Tensor,
    off: Tensor,
    unit: Tensor,
    start: StateNoise | None = None,
    climb: bool = True,
) -> Likelihood:
    """The most likely state noise of a residual (S, C) beside linear parameters.

    jacobian (S, C, P): of the readings by the parameters, which have normal priors of precision pull^2 (P,) about -off
    standard deviations from where they stand. unit (n,) m^3/s: the order of magnitude of a disturbance. start: where to
    begin. climb: whether the correlation time climbs along CORRELATION_TIMES from there; it stays otherwise. Where a
    sensor wanders, it is the correlation time of that.
    """
    problem = _Problem(propagation, sensors, residual, jacobian, pull, off, unit)
    interval = propagation.interval
    if start is None:
        start = StateNoise(unit, interval * CORRELATION_TIMES[2], torch.ones_like(sensors.std))
    if not climb:
        return problem.solve(start)
    if start.wander is not None:
        return problem.climbed(
            start, [c * interval for c in CORRELATION_TIMES[1:]], start.wander.correlation_time, _slowed
        )
    times = [c * interval for c in CORRELATION_TIMES]
    return problem.climbed(start, times, start.correlation_time, partial(_retimed, interval=interval))


def _retimed(noise: StateNoise, time: float, interval: float) -> StateNoise:
    """The same volumes that come and go slowly, with another correlation time."""
    before, after = (max(2.0 * t, interval) for t in (noise.correlation_time, time))
    return replace(noise, correlation_time=time, intensity=noise.intensity * math.sqrt(before / after))


def _slowed(noise: StateNoise, time: float) -> StateNoise:
    """The same with another correlation time of what a sensor wanders by."""
    assert noise.wander is not None
    return replace(noise, wander=replace(noise.wander, correlation_time=time))


@dataclass(frozen=True)
class _Problem:
    propagation: Propagation
    sensors: SensorNoise
    residual: Tensor
    jacobian: Tensor
    pull: Tensor
    off: Tensor
    unit: Tensor

    @cached_property
    def filter(self) -> KalmanFilter:
        return KalmanFilter(self.propagation, self.sensors)

    @cached_property
    def columns(self) -> Tensor:
        """(S, C, 1 + P)."""
        return torch.cat([self.residual.unsqueeze(-1), self.jacobian], dim=-1)

    def climbed(
        self, start: StateNoise, times: Sequence[float], near: float, moved: Callable[[StateNoise, float], StateNoise]
    ) -> Likelihood:
        """The most likely noise at each of the times, from the one next to `near` on, up and down while that is better.

        moved: a noise with another of the times.
        """
        middle = min(range(len(times)), key=lambda i: abs(times[i] - near))
        best = self.solve(moved(start, times[middle]))
        for step in (1, -1):
            i = middle + step
            while 0 <= i < len(times):
                further = self.solve(moved(best.noise, times[i]))
                if further.log_likelihood <= best.log_likelihood:
                    break
                best, i = further, i + step
        return best

    def solve(self, start: StateNoise) -> Likelihood:
        tanks, known_as = len(self.unit), start.wander

        def noise_at(x: np.ndarray) -> StateNoise:
            log = torch.from_numpy(x)
            scale = torch.exp(log[tanks : tanks + len(start.scale)])
            wander = known_as and replace(known_as, std=known_as.std * math.exp(float(log[-1])))
            return replace(start, intensity=self.unit * torch.exp(log[:tanks]), scale=scale, wander=wander)

        # In units in which the curvature per sample is about one. The tolerance of L-BFGS is a share of the cost, or of
        # one where that is more, so the cost counts from the start.
        samples, (known, by) = len(self.residual), self.likelihood(start)
        unit = torch.sqrt(2.0 * by.determined.clamp(min=LEAST) / samples).numpy()

        def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
            value, by = self.likelihood(noise_at(x / unit))
            return (known - value) / samples, -by.slope.numpy() / samples / unit

        first = torch.cat([torch.log(start.intensity / self.unit), torch.log(start.scale)])
        first = torch.cat([first, first.new_zeros(1)]) if known_as else first
        done = minimize(
            cost,
            first.clamp(-WIDEST, WIDEST).numpy() * unit,
            jac=True,
            method="L-BFGS-B",
            bounds=[(-WIDEST * u, WIDEST * u) for u in unit],
            options={"ftol": SETTLED / samples, "gtol": SETTLED / samples},
        )
        return Likelihood(noise_at(done.x / unit), known - float(done.fun) * samples, bool(done.success))

    def likelihood(self, noise: StateNoise) -> tuple[float, Score]:
        """The profile log-likelihood, and its score."""
        model = self.filter.under(noise)
        left, moved = _regressed(model.innovations(self.columns), self.pull, self.off)
        cost = float(left.square().sum()) + float(moved.square().sum()) + model.log_det
        return -0.5 * cost, model.score(left)


def _regressed(white: Tensor, pull: Tensor, off: Tensor) -> tuple[Tensor, Tensor]:
    """white (S, C, 1 + P): what is left of the first column beside the others, (S, C), and of the priors' rows (P,)."""
    rows = white.flatten(0, 1)
    gram = rows.T @ rows
    curvature, right = gram[1:, 1:] + torch.diag(pull**2), gram[1:, 0] - pull * off
    scale = torch.diagonal(curvature).sqrt().clamp(min=1e-150)
    unit = curvature / scale / scale.unsqueeze(1) + RIDGE * torch.eye(len(pull), dtype=white.dtype)
    step = torch.linalg.solve(unit, (right / scale).unsqueeze(1)).squeeze(1) / scale
    return white @ torch.cat([step.new_ones(1), -step]), -off - pull * step
