"""Maximum-likelihood estimate of the noise model: flow disturbances, sensor noise and their correlation time.

Intensities and scales maximise the likelihood of the innovations (kalman.py) times a prior: disturbances of all tanks
are of one order of magnitude, since a significant diffusion term in one state equation shows where a model is deficient
(Kristensen, Madsen and Jorgensen, 2004, Automatica 40, 225-237). The gradient comes from the disturbance
smoother (Durbin and Koopman, 2012, "Time series analysis by state space methods", section 7.3.3). The likelihood is
averaged over the plant parameters, in which the residuals are linear: with the most likely parameters instead, flows
that look like errors of parameters would be lost (restricted maximum likelihood, Patterson and Thompson, 1971,
Biometrika 58, 545-554). The correlation time is selected from a grid of candidates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import itemgetter

import numpy as np
import torch
from torch import Tensor

from fdi_torch.estimate.kalman import KalmanFilter, Propagation, Score
from fdi_torch.estimate.noise_model import SCATTER, SensorNoise, StateNoise

CORRELATION_TIMES = (0.0, 5.0, 20.0, 80.0, 320.0)  # grid of candidates, in sampling intervals; 0: white
LIKELIHOOD_TOLERANCE = 0.1  # nats; the optimisation ends when an iteration gains less
RIDGE = 1e-12  # relative to a unit curvature: keeps parameters without information in their place
MIN_DETERMINED = 1e-2  # lower limit on the effective number of readings per parameter, for its scaling
LOG_BOUND = 10.0  # bound on |log(intensity / unit)| and |log(scale)| in the optimisation


@dataclass(frozen=True)
class Likelihood:
    """Maximum of the likelihood.

    noise: the maximising noise model. log_likelihood: of the residuals, maximised over the noise model and integrated
    over the linear parameters, the log density of the priors of both included; constants of the normal distribution and
    of the priors are omitted.
    converged: whether the optimisation of the noise model converged. determined: effective number of readings that
    determine each of its parameters, in the order of `Score.slope`.
    """

    noise: StateNoise
    log_likelihood: float
    start_log_likelihood: float
    converged: bool
    determined: Tensor


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
    """Estimate the noise model from residuals (S, C), averaged over the plant parameters.

    jacobian (S, C, P): derivatives of the readings by the P parameters.
    pull, off (P,): normal priors of the parameters. A parameter change delta has the prior residual off + pull * delta
    of unit variance: precision pull^2, and `off` prior standard deviations between current value and prior mean.
    unit (n,), m^3/s: order of magnitude of a flow disturbance. start: initial noise model.
    climb: whether to search CORRELATION_TIMES for the best correlation time; otherwise that of `start` is retained. The
    search is over the wander's correlation time and smoothness if a sensor wanders, else over the correlation time of
    the flow disturbances.
    """
    problem = _Problem(propagation, sensors, residual, jacobian, pull, off, unit)
    interval = propagation.usual_interval
    if start is None:
        start = StateNoise(unit, interval * CORRELATION_TIMES[2], torch.ones_like(sensors.std))
    if not climb:
        return problem.solve(start)
    times = [c * interval for c in CORRELATION_TIMES]
    if (wander := start.wander) is not None:
        starts = [replace(start, wander=replace(wander, smooth=smooth)) for smooth in (False, True)]
        climbs = [
            problem.climbed(each, times[1:], wander.correlation_time, _with_wander_correlation_time) for each in starts
        ]
        return max(climbs, key=lambda likely: likely.log_likelihood)
    return problem.climbed(
        start, times, start.correlation_time, partial(_with_flow_correlation_time, interval=interval)
    )


def _with_flow_correlation_time(noise: StateNoise, time: float, interval: float) -> StateNoise:
    """The noise model with another correlation time of the flow disturbances.

    The intensity is adjusted such that the variance of the disturbance integrated over a long time, which is
    proportional to intensity^2 max(2 tau, dt), does not change.
    """
    before, after = (max(2.0 * t, interval) for t in (noise.correlation_time, time))
    return replace(noise, correlation_time=time, intensity=noise.intensity * math.sqrt(before / after))


def _with_wander_correlation_time(noise: StateNoise, time: float) -> StateNoise:
    """The noise model with another correlation time of the wander."""
    assert noise.wander is not None
    return replace(noise, wander=replace(noise.wander, correlation_time=time))


@dataclass(frozen=True)
class _Problem:
    """The likelihood of one residual as a function of the noise model; fields as in `estimate_state_noise`."""

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
        """Residual and Jacobian side by side, (S, C, 1 + P), with time last in memory."""
        columns = torch.cat([self.residual.unsqueeze(-1), self.jacobian], dim=-1)
        return columns.permute(1, 2, 0).contiguous().permute(2, 0, 1)

    def climbed(
        self,
        start: StateNoise,
        times: Sequence[float],
        first_time: float,
        with_time: Callable[[StateNoise, float], StateNoise],
    ) -> Likelihood:
        """Hill climbing over the grid of correlation times, s, from the one nearest to `first_time`.

        At each time the other noise parameters are optimised. with_time: sets the correlation time of a noise model.
        """

        def at(noise: StateNoise, time: float) -> Likelihood:
            # The likelihood is flat in the logarithms of flows that move no level.
            flows = torch.maximum(noise.intensity, self.unit)
            return self.solve(with_time(replace(noise, intensity=flows), time))

        middle = min(range(len(times)), key=lambda i: abs(times[i] - first_time))
        first = best = at(start, times[middle])
        for step in (1, -1):
            i = middle + step
            while 0 <= i < len(times):
                candidate = at(best.noise, times[i])
                if candidate.log_likelihood <= best.log_likelihood:
                    break
                best, i = candidate, i + step
        return replace(best, start_log_likelihood=first.start_log_likelihood)

    def solve(self, start: StateNoise) -> Likelihood:
        """Maximise the likelihood over the logarithms of intensities, scales and wander, by L-BFGS-B."""
        tanks, start_wander = len(self.unit), start.wander

        def noise_at(x: np.ndarray) -> StateNoise:
            log = torch.from_numpy(x)
            scale = torch.exp(log[tanks : tanks + len(start.scale)])
            wander = start_wander and replace(start_wander, std=start_wander.std * math.exp(float(log[-1])))
            return replace(start, intensity=self.unit * torch.exp(log[:tanks]), scale=scale, wander=wander)

        # The variables are scaled to a curvature of about one per sample. The tolerance of L-BFGS-B is relative to
        # max(|cost|, 1), so the cost is taken relative to its initial value.
        samples, likeliest = len(self.residual), self.likelihood(start)
        start_value, first_score = likeliest
        unit = torch.sqrt(2.0 * first_score.determined.clamp(min=MIN_DETERMINED) / samples).numpy()

        log_start = torch.cat([torch.log(start.intensity / self.unit), torch.log(start.scale)])
        log_start = torch.cat([log_start, log_start.new_zeros(1)]) if start_wander else log_start
        x_start = log_start.numpy() * unit

        def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal likeliest
            value, score = (start_value, first_score) if (x == x_start).all() else self.likelihood(noise_at(x / unit))
            likeliest = max(likeliest, (value, score), key=itemgetter(0))
            return (start_value - value) / samples, -score.slope.numpy() / samples / unit

        from scipy.optimize import minimize  # it takes 0.3 s to load, and few jobs have random flows

        optimum = minimize(
            cost,
            x_start.clip(-LOG_BOUND * unit, LOG_BOUND * unit),
            jac=True,
            method="L-BFGS-B",
            bounds=[(-LOG_BOUND * u, LOG_BOUND * u) for u in unit],
            options={"ftol": LIKELIHOOD_TOLERANCE / samples, "gtol": LIKELIHOOD_TOLERANCE / samples},
        )
        noise, value = noise_at(optimum.x / unit), start_value - float(optimum.fun) * samples
        return Likelihood(noise, value, start_value, bool(optimum.success), likeliest[1].determined)

    def likelihood(self, noise: StateNoise) -> tuple[float, Score]:
        """Log-likelihood of a noise model with the log prior of its intensities, and its score."""
        model = self.filter.under(noise)
        innovations, cost = _averaged(model.innovations(self.columns), self.pull, self.off)
        cost += model.log_det
        score, deviation = model.score(innovations), noise.scatter() / SCATTER
        slope, determined = score.slope.clone(), score.determined.clone()
        slope[: len(deviation)] -= deviation
        determined[: len(deviation)] += torch.where(noise.tied, 0.5 / SCATTER**2, 0.0)
        return -0.5 * cost + noise.log_prior(), replace(score, slope=slope, determined=determined)


def _averaged(white: Tensor, pull: Tensor, off: Tensor) -> tuple[Tensor, float]:
    """Average a Gaussian likelihood over the linear parameters, with their normal priors.

    white (S, C, 1 + P): whitened residual and Jacobian. Returns the innovations under the most likely parameters,
    beside what the errors of these add to them as P independent columns, (S, C, 1 + P); and -2 ln of the average,
    without the log determinants of the innovations and of the priors, which may be improper (`pull` 0).
    """
    columns = white.permute(1, 2, 0)
    gram = (columns @ columns.mT).sum(dim=0)
    curvature, right = gram[1:, 1:] + torch.diag(pull**2), gram[1:, 0] - pull * off
    scale = torch.diagonal(curvature).sqrt().clamp(min=1e-150)
    unit = curvature / scale / scale.unsqueeze(1) + RIDGE * torch.eye(len(pull), dtype=white.dtype)
    root, failed = torch.linalg.cholesky_ex(unit)
    root = torch.where(failed > 0, torch.nan, root)  # where the innovations are not finite
    step = torch.cholesky_solve((right / scale).unsqueeze(1), root).squeeze(1) / scale
    mixing = torch.zeros(1 + len(pull), 1 + len(pull), dtype=white.dtype)
    mixing[0, 0], mixing[1:, 0] = 1.0, -step
    identity = torch.eye(len(pull), dtype=white.dtype)
    mixing[1:, 1:] = torch.linalg.solve_triangular(root.mT, identity, upper=True) / scale.unsqueeze(1)
    innovations = (mixing.T @ columns).permute(2, 0, 1)
    log_det = 2.0 * float((torch.diagonal(root).log() + scale.log()).sum())
    misfit = float(innovations[..., 0].square().sum()) + float((off + pull * step).square().sum())
    return innovations, misfit + log_det
