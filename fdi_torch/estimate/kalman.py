"""Random flows into the tanks beside the noise of the sensors: the Kalman filter and smoother about a trajectory.

About a trajectory the deviation x of the levels, the disturbing flows w and correlated sensor noise v obey

    x_{s+1} = A_s x_s + B_s w_s,   w_{s+1} = exp(-dt/tau) w_s + q_s,   v_{s+1} = a v_s + p_s
    y_s     = C_s x_s + v_s                                                    (residuals of the readings)

from sample to sample, with var(w_i) = intensity_i^2 and var(v_c) = (scale_c std_c)^2. One of the sensors may wander
beside: its reading holds another such term, slow and of any size. The filter turns residuals, and
whatever else is linear in the levels, into innovations of unit variance (Särkkä, 2013, "Bayesian filtering and
smoothing", chapter 4). Disturbances are what every real rig has: waves, pulsation, splashing. They are no fault.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fdi_torch.simulate.build import load_library


@dataclass(frozen=True)
class Propagation:
    """How flows into the tanks reach the readings along one trajectory, from sample to sample.

    transition (S, n, n): A. forcing (S, n, n) s/m^2: B, of flows in m^3/s that last from a sample to the next.
    output (S, C, n): C, in each reading's unit per m. interval: s, between samples. fresh (S,): where a recording
    begins, with known levels. mask (S, C): which readings there are.
    """

    transition: Tensor
    forcing: Tensor
    output: Tensor
    interval: float
    fresh: Tensor
    mask: Tensor


@dataclass(frozen=True)
class Wander:
    """What a sensor's reading is wrong by, slowly and at random. std: in the reading's unit; correlation_time: s."""

    channel: int
    std: float
    correlation_time: float


@dataclass(frozen=True)
class StateNoise:
    """intensity (n,): standard deviation of the random flow into each tank, m^3/s. correlation_time: s, 0 for white
    (a new value each sample). scale (C,): factor on the standard deviation of each sensor's noise.
    """

    intensity: Tensor
    correlation_time: float
    scale: Tensor
    wander: Wander | None = None


@dataclass(frozen=True)
class SensorNoise:
    """std (C,) in the reading's unit, and the correlation of neighbouring samples (C,)."""

    std: Tensor
    correlation: Tensor


class KalmanFilter:
    """The filter of one propagation, for any noise."""

    def __init__(self, propagation: Propagation, sensors: SensorNoise) -> None:
        p = propagation
        self.samples, self.channels, self.tanks = p.output.shape
        self.sensors, self.interval = sensors, p.interval
        self.correlated = bool((sensors.correlation != 0.0).any())
        self.matrices = tuple(x.contiguous() for x in (p.transition, p.forcing, p.output))
        self.flags = tuple(x.to(torch.uint8).contiguous() for x in (p.mask, p.fresh))

    def under(self, noise: StateNoise) -> Filtered:
        return Filtered(self, noise)

    def kept(self, time: float) -> float:
        """The share of what decays over a correlation time, s, that is left at the next sample."""
        return math.exp(-self.interval / time) if time > 0.0 else 0.0


class Filtered:
    """The filter under one noise. log_det: of the innovations' variances, summed over what was read."""

    def __init__(self, own: KalmanFilter, noise: StateNoise) -> None:
        self.own, self.wanders = own, noise.wander is not None
        of_sensors, nothing = (noise.scale * own.sensors.std) ** 2, torch.zeros_like(noise.scale)
        decays = [(torch.full_like(noise.intensity, own.kept(noise.correlation_time)), noise.intensity**2)]
        decays += [(own.sensors.correlation, of_sensors)] if own.correlated else []
        self.r = nothing if own.correlated else of_sensors
        if (slow := noise.wander) is not None:
            of_wander = nothing.index_fill(0, torch.tensor(slow.channel), slow.std**2)
            decays.append((torch.full_like(nothing, own.kept(slow.correlation_time)), of_wander))
        keep, variance = (torch.cat(parts) for parts in zip(*decays, strict=True))
        self.keep, self.q = keep, (1.0 - keep**2) * variance
        self.p0 = torch.cat([variance.new_zeros(own.tanks), variance])
        given = (*own.matrices, self.keep, self.q, self.r, self.p0, *own.flags)
        self._model = _Model(*(t.data_ptr() for t in given))
        self._library = _library(own.tanks, own.channels, len(decays) - 1)
        self.gain = variance.new_empty(own.samples, len(self.p0), own.channels)
        self.white = variance.new_empty(own.samples, own.channels, own.channels)
        self.log_det = float(self._run("kalman_gains", self.gain, self.white))

    def innovations(self, y: Tensor) -> Tensor:
        """y (S, C, M) -> the same, whitened; what is masked is 0."""
        y = y.contiguous()
        out = torch.empty_like(y)
        self._run("kalman_innovations", y.shape[-1], self.gain, self.white, y, out)
        return out

    def transposed(self, v: Tensor) -> Tensor:
        """v (S, C, M) -> u, with sum(u y) = sum(v w) for all readings y whose innovations are w."""
        v = v.contiguous()
        out = torch.empty_like(v)
        self._run("kalman_transposed", v.shape[-1], self.gain, self.white, v, out)
        return out

    def score(self, nu: Tensor) -> Score:
        """About innovations (S, C) of unit variance."""
        slopes, seen = ([torch.empty_like(x) for x in (self.q, self.r, self.p0)] for _ in range(2))
        shocks = nu.new_empty(self.gain.shape[:2])
        self._run("kalman_score", self.gain, self.white, nu.contiguous(), *slopes, *seen, shocks)
        return Score(self._by_deviation(*slopes), self._by_deviation(*seen), shocks)

    def _by_deviation(self, by_q: Tensor, by_r: Tensor, by_p0: Tensor) -> Tensor:
        """Slopes by variances -> by the logarithm of each standard deviation: twice the variance times the slope."""
        tanks, channels = self.own.tanks, self.own.channels
        decaying = 2.0 * (by_q * self.q + by_p0[tanks:] * self.p0[tanks:])
        of_sensors = decaying[tanks : tanks + channels] if self.own.correlated else 2.0 * by_r * self.r
        wander = decaying[-channels:].sum().reshape(1) if self.wanders else decaying[:0]
        return torch.cat([decaying[:tanks], of_sensors, wander])

    def smoothed(self, residual: Tensor) -> Tensor:
        """residual (S, C) -> the expected deviation of the levels from the trajectory, (S, n) m, given all readings."""
        shocks = self.score(self.innovations(residual.unsqueeze(-1)).squeeze(-1)).shocks
        levels = residual.new_empty(self.own.samples, self.own.tanks)
        self._run("kalman_levels", shocks, levels)
        return levels

    def _run(self, name: str, *arguments: Tensor | int) -> Any:
        function = getattr(self._library, name)
        function.restype = ctypes.c_double if name == "kalman_gains" else None
        passed = [ctypes.c_int64(a) if isinstance(a, int) else ctypes.c_void_p(a.data_ptr()) for a in arguments]
        return function(ctypes.c_int64(self.own.samples), ctypes.byref(self._model), *passed)


@dataclass(frozen=True)
class Score:
    """slope: of the log-likelihood by the logarithms of the intensities (n,), of the scales (C,) and of a wander.
    determined: how many readings each of them is determined by, whose expected slope is nothing: that many times two is
    about how the slope falls. shocks (S, d): smoothed.
    """

    slope: Tensor
    determined: Tensor
    shocks: Tensor


class KalmanWhitening:
    """Turns residuals into innovations of unit variance. log_det: of the innovations' variances, summed."""

    def __init__(self, propagation: Propagation, sensors: SensorNoise, noise: StateNoise) -> None:
        self._filtered = KalmanFilter(propagation, sensors).under(noise)
        self.log_det = self._filtered.log_det
        self.smoothed, self.transposed = self._filtered.smoothed, self._filtered.transposed

    def __call__(self, x: Tensor) -> Tensor:
        """x (*lanes, S, C) or (*lanes, S, C, P) -> the same, whitened; what is masked is 0."""
        samples, channels = self._filtered.own.samples, self._filtered.own.channels
        columns = x.shape[-2:] != (samples, channels)
        last = x if columns else x.unsqueeze(-1)
        lanes = last.shape[:-3]
        flat = last.flatten(0, -4) if lanes else last.unsqueeze(0)
        wide = flat.permute(1, 2, 0, 3).reshape(samples, channels, -1)
        white = self._filtered.innovations(wide).reshape(samples, channels, *flat.shape[::3])
        white = white.permute(2, 0, 1, 3).reshape(last.shape)
        return white if columns else white.squeeze(-1)


class _Model(ctypes.Structure):
    """Of kalman.hpp, in its order."""

    _fields_ = tuple((name, ctypes.c_void_p) for name in ("a", "b", "h", "keep", "q", "r", "p0", "seen", "fresh"))


@lru_cache
def _library(tanks: int, channels: int, layers: int) -> ctypes.CDLL:
    sizes = f"#define TANKS {tanks}\n#define CHANNELS {channels}\n#define LAYERS {layers}\n"
    source = sizes + Path(__file__).with_name("kalman.hpp").read_text(encoding="utf-8")
    names = ("gains", "innovations", "transposed", "score", "levels")
    return load_library(source, *(f"kalman_{name}" for name in names))
