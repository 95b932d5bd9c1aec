"""Kalman filter and smoother for random flow disturbances and sensor noise, linearised about a simulated trajectory.

The deviation x of the state (levels, and states of effects) from the trajectory, the flow disturbances w of the tanks,
the sensor noise v and the residuals y of the readings obey, from sample s to the next,

    x_{s+1} = A_s x_s + f_s B_s w_s
    w_{s+1} = exp(-dt_s / tau) w_s + q_s        var(w_i) = intensity_i^2
    v_{s+1} = a v_s + p_s                       var(v_c) = (scale_c std_c)^2
    y_s     = C_s x_s + v_s

with white shocks q and p, and times dt_s between samples that may differ. A flow f w is constant over dt; therefore

    f_s^2 = D(usual dt) / D(dt_s),    D(dt) = dt coth(dt / (2 tau)),

with which the variance of its integral over a long time is the same at any dt. One sensor may have an additional slow
random drift z in its reading (`Wander`), with further components of x and their own w. The filter turns residuals, and
their derivatives by parameters, into innovations of unit variance (Särkkä, 2013, "Bayesian filtering and smoothing",
chapter 4). The disturbances model waves, pulsation and splashing, which occur on every real rig and are not faults.

S: samples, C: sensors (channels), n: states (levels and states of effects), d: states of the filter, M: columns that
are filtered together.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from fdi_torch.estimate.noise_model import SensorNoise, StateNoise, Wander
from fdi_torch.simulate.build import REGISTER, load_library


@dataclass(frozen=True)
class Propagation:
    """Linearised dynamics from flow disturbances to readings along a trajectory.

    transition (S, n, n): A. forcing (S, n, n), s/m^2: B, for flows in m^3/s that are constant between samples.
    output (S, C, n): C, in each reading's unit per m.
    interval (S,): dt, time to the next sample of the same recording, s; the usual interval where there is none.
    fresh (S,): true at the first sample of each recording, where the deviation of the levels is zero.
    mask (S, C): true for valid readings.
    """

    transition: Tensor
    forcing: Tensor
    output: Tensor
    interval: Tensor
    fresh: Tensor
    mask: Tensor

    @property
    def usual_interval(self) -> float:
        """Median time between samples, s."""
        return float(self.interval.median())


class KalmanFilter:
    """Kalman filter of one linearised trajectory, before the noise model is given; `under` supplies that."""

    def __init__(self, propagation: Propagation, sensors: SensorNoise) -> None:
        self.propagation, self.sensors, p = propagation, sensors, propagation
        self.samples, self.channels, self.order = p.output.shape
        self.correlated = bool((sensors.correlation != 0.0).any())
        self.matrices = tuple(x.contiguous() for x in (p.transition, p.forcing, p.output))
        self.flags = tuple(x.to(torch.uint8).contiguous() for x in (p.mask, p.fresh))

    def under(self, noise: StateNoise) -> KalmanWhitening:
        """The filter with its gains for this noise model."""
        return KalmanWhitening(self, noise)

    def kept(self, time: float) -> Float[Tensor, " S"]:
        """Decay factors exp(-dt / time) from sample to sample; time: correlation time, s, 0 for white noise."""
        interval = self.propagation.interval
        return torch.exp(-interval / time) if time > 0.0 else torch.zeros_like(interval)

    def forced(self, time: float) -> tuple[Tensor, ...]:
        """The matrices A, f B and C for flows of this correlation time, s."""
        p, (transition, forcing, output) = self.propagation, self.matrices
        steps = torch.cat([p.interval, p.interval.new_tensor([p.usual_interval])])
        density = steps / torch.tanh(0.5 * steps / time) if time > 0.0 else steps
        return transition, forcing * torch.sqrt(density[-1] / density[:-1, None, None]), output

    def drift(self, wander: Wander) -> tuple[Tensor, Tensor]:
        """The matrices A and B (S, k, k) of a drift of unit variance and, if it is smooth, tau times its rate.

        A = exp(F x), F = -1, or for a smooth drift [[0, 1], [-1, -2]]; B B' = 1 - A A', since the stationary covariance
        is 1.
        """
        x = self.propagation.interval / wander.correlation_time
        if not wander.smooth:
            return torch.exp(-x)[:, None, None], torch.sqrt(-torch.expm1(-2.0 * x))[:, None, None]
        decay = torch.exp(-2.0 * x)
        a = torch.exp(-x)[:, None] * torch.stack([1.0 + x, x, -x, 1.0 - x], dim=-1)
        # 1 - decay (1 + 2 x + 2 x^2), which is of the order of x^3
        first = torch.sqrt(torch.special.gammainc(torch.full_like(x, 3.0), 2.0 * x))
        across = torch.where(first > 0.0, 2.0 * x * x * decay / first, 0.0)
        second = torch.sqrt((1.0 - decay * (1.0 - 2.0 * x + 2.0 * x * x) - across**2).clamp(min=0.0))
        return a.reshape(-1, 2, 2), torch.stack([first, 0.0 * x, across, second], dim=-1).reshape(-1, 2, 2)


class KalmanWhitening:
    """Kalman filter with the gains of one noise model, which whitens residuals.

    gain (S, d, C): Kalman gains. white (S, C, C): inverse Cholesky factors of the innovations' covariances.
    log_det: log determinant of these covariances, summed over all valid readings.
    """

    def __init__(self, kalman_filter: KalmanFilter, noise: StateNoise) -> None:
        self.own, self.noise = kalman_filter, noise
        of_sensors, zeros = (noise.scale * kalman_filter.sensors.std) ** 2, torch.zeros_like(noise.scale)
        self.flows = len(noise.intensity)
        variance = torch.cat([noise.intensity**2, noise.intensity.new_zeros(kalman_filter.order - self.flows)])
        matrices = kalman_filter.forced(noise.correlation_time)
        decay = kalman_filter.kept(noise.correlation_time).unsqueeze(1).repeat(1, len(variance))
        start = torch.zeros_like(variance)
        if (wander := noise.wander) is not None:
            drift = kalman_filter.drift(wander)
            k = drift[0].shape[-1]
            matrices = tuple(pad(x, (0, k, 0, rows)) for x, rows in zip(matrices, (k, k, 0), strict=True))
            matrices[0][:, -k:, -k:], matrices[1][:, -k:, -k:] = drift
            matrices[2][:, wander.channel, -k] = 1.0
            variance, start = (pad(x, (0, k), value=wander.std**2) for x in (variance, start))
            decay = pad(decay, (0, k))
        self.order = len(start)
        if kalman_filter.correlated:
            of_samples = kalman_filter.sensors.correlation.expand(len(decay), -1)
            variance, decay = torch.cat([variance, of_sensors]), torch.cat([decay, of_samples], dim=1)
        self.r = zeros if kalman_filter.correlated else of_sensors
        self.keep, self.q = decay, (1.0 - decay**2) * variance
        self.p0 = torch.cat([start, variance])
        self._tensors = (*matrices, self.keep, self.q, self.r, self.p0, *kalman_filter.flags)
        self._model = _Model(*(t.data_ptr() for t in self._tensors))
        self._library = _library(self.order, kalman_filter.channels, int(kalman_filter.correlated))
        self.gain = variance.new_empty(kalman_filter.samples, len(self.p0), kalman_filter.channels)
        self.white = variance.new_empty(kalman_filter.samples, kalman_filter.channels, kalman_filter.channels)
        self.log_det = float(self._run("kalman_gains", self.gain, self.white))

    def __call__(self, x: Tensor) -> Tensor:
        """Innovations of unit variance, in the shape of x (*lanes, S, C) or (*lanes, S, C, P); 0 where masked."""
        samples, channels = self.own.samples, self.own.channels
        has_columns = x.shape[-2:] != (samples, channels)
        with_columns = x if has_columns else x.unsqueeze(-1)
        lanes = with_columns.shape[:-3]
        flat = with_columns.flatten(0, -4) if lanes else with_columns.unsqueeze(0)
        side_by_side = flat.permute(1, 2, 0, 3).reshape(samples, channels, -1)
        white = self.innovations(side_by_side).reshape(samples, channels, *flat.shape[::3])
        white = white.permute(2, 0, 1, 3).reshape(with_columns.shape)
        return white if has_columns else white.squeeze(-1)

    def innovations(self, y: Float[Tensor, "S C M"]) -> Float[Tensor, "S C M"]:
        """Innovations (S, C, M) of unit variance of residuals y (S, C, M); 0 where masked."""
        return self._run_on_columns("kalman_innovations", y)

    def transposed(self, v: Float[Tensor, "S C M"]) -> Float[Tensor, "S C M"]:
        """Adjoint of `innovations`: u (S, C, M) such that sum(u y) = sum(v innovations(y)) for every y."""
        return self._run_on_columns("kalman_transposed", v)

    def score(self, nu: Float[Tensor, "S C M"]) -> Score:
        """Score of the log-likelihood, given innovations nu (S, C, M) of unit variance, the mean product nu nu' of
        which is the sum over the M columns. Its shocks are those of the first column."""
        slopes, information = ([torch.empty_like(x) for x in (self.q[0], self.r, self.p0)] for _ in range(2))
        shocks = nu.new_empty(self.gain.shape[:2])
        columns = nu.permute(1, 2, 0).contiguous()
        self._run("kalman_score", nu.shape[-1], self.gain, self.white, columns, *slopes, *information, shocks)
        return Score(self._by_deviation(*slopes), self._by_deviation(*information), shocks)

    def _by_deviation(self, by_q: Tensor, by_r: Tensor, by_p0: Tensor) -> Tensor:
        """Derivatives by log standard deviations from those by log factors on q, and by the variances r and p0:
        df/dlog(s) = 2 s^2 df/d(s^2)."""
        own, order, at_start = self.own.order, self.order, 2.0 * by_p0 * self.p0
        decaying = 2.0 * by_q + at_start[order:]
        of_sensors = decaying[order:] if self.own.correlated else 2.0 * by_r * self.r
        of_drift = (decaying[own:order] + at_start[own:order]).sum(0, keepdim=True)
        return torch.cat([decaying[: self.flows], of_sensors, of_drift[: order - own]])

    def smoothed(self, residual: Float[Tensor, "S C"]) -> Float[Tensor, "S n"]:
        """Smoothed deviation of the levels from the trajectory, (S, n) m, given all residuals (S, C)."""
        shocks = self.score(self.innovations(residual.unsqueeze(-1))).shocks
        states = residual.new_empty(self.own.samples, self.order)
        self._run("kalman_levels", shocks, states)
        return states[:, : self.own.order]

    def predicted(self, residual: Float[Tensor, "S C"]) -> Float[Tensor, "S n"]:
        """Deviation of the levels from the trajectory, (S, n) m, predicted for each sample from the residuals (S, C) of
        all earlier ones."""
        states = residual.new_empty(self.own.samples, self.order)
        self._run("kalman_predictions", self.gain, residual.contiguous(), states)
        return states[:, : self.own.order]

    def _run_on_columns(self, name: str, x: Tensor) -> Tensor:
        """x (S, C, M) -> (S, C, M), with time last in memory."""
        columns = x.permute(1, 2, 0).contiguous()
        out = torch.empty_like(columns)
        self._run(name, x.shape[-1], self.gain, self.white, columns, out)
        return out.permute(2, 0, 1)

    def _run(self, name: str, *arguments: Tensor | int) -> Any:
        function = getattr(self._library, name)
        function.restype = ctypes.c_double if name == "kalman_gains" else None
        c_arguments = [ctypes.c_int64(a) if isinstance(a, int) else ctypes.c_void_p(a.data_ptr()) for a in arguments]
        return function(ctypes.c_int64(self.own.samples), ctypes.byref(self._model), *c_arguments)


@dataclass(frozen=True)
class Score:
    """Derivatives of the log-likelihood by the logarithms of the parameters of the noise.

    slope: first derivatives, by the intensities of the flows (n,), the scales of the sensors' noise (C,) and the
    standard deviation of the wander, if there is one. determined: effective number of readings that determine each of
    these parameters; the second derivative is about -2 times this number. shocks (S, d): smoothed random changes of the
    state from sample to sample.
    """

    slope: Tensor
    determined: Tensor
    shocks: Tensor


class _Model(ctypes.Structure):
    """`Model` of kalman.hpp, with its fields in the same order."""

    _fields_ = tuple((name, ctypes.c_void_p) for name in ("a", "b", "h", "keep", "q", "r", "p0", "seen", "fresh"))


@lru_cache
def _library(tanks: int, channels: int, layers: int) -> ctypes.CDLL:
    """kalman.hpp compiled for these sizes; layers: 1 if the noise of the channels is correlated in time, else 0."""
    sizes = f"#define TANKS {tanks}\n#define CHANNELS {channels}\n#define LAYERS {layers}\n"
    headers = REGISTER, Path(__file__).with_name("kalman.hpp")
    source = "".join([sizes, *(header.read_text(encoding="utf-8") for header in headers)])
    names = ("gains", "innovations", "transposed", "score", "predictions", "levels")
    return load_library(source, *(f"kalman_{name}" for name in names))
