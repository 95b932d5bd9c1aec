"""Random flows into the tanks in the monitor's residual: the Kalman filter that takes them out.

The noise model is that of the gap diagnosis (estimate/state_noise.py): flows w with a correlation time, measurement
noise v that is white or correlated from sample to sample. About the plant linearised at the operating point, the error
x of the observer's prediction obeys

    x_{k+1} = A (x_k - L_k r_k) + B w_k,    w_{k+1} = a w_k + q_k,    v_{k+1} = c v_k + p_k,    r_k = C x_k + v_k,

with the observer's gain L and residual r. The Kalman filter for (x, w), and for v if c > 0, turns r into innovations
that are white whatever the gain L is. Flows are in metres per sample: what each adds to its tank's level in one
sampling interval.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import torch
from torch import Tensor

from fdi_torch.estimate.noise_model import SCATTER, StateNoise
from fdi_torch.estimate.state_noise import LOG_BOUND
from fdi_torch.monitor.observer_gain import Gain, Linear, kalman_gain, riccati, with_effects
from fdi_torch.simulate.build import load_library

FREQUENCIES = 2048  # at which spectra are evaluated
WHITE_SHARE = 1e-3  # of the standard deviation of correlated measurement noise: keeps its covariance invertible


@dataclass(frozen=True)
class FlowFilter:
    """The Kalman filter for one observer.

    n: the network's states, the levels of the tanks first; only tanks receive flows, the others' are 0.

    linear: transition A (n, n) and output C (sensors, n). noise: intensities of the tanks in m per sample. reading_std
    (sensors,): measurement noise; correlation: of its neighbouring values, the same for all sensors. observer: the
    observer's gain. start_std (tanks,): of the initial levels, m.
    interval: s. learnt (samples, sensors): what the residual that the noise was learnt from would have been without
    the observer's corrections, NaN where a reading is missing. by_constants (samples, sensors, P): its derivatives by
    the errors of constants, in standard deviations of their priors; expected (P,): the means of these priors. begins:
    number of samples that the observer had processed before the filter starts, from unknown levels and flows.
    """

    linear: Linear
    noise: StateNoise
    reading_std: Tensor
    observer: Gain
    start_std: Tensor
    interval: float
    learnt: Tensor
    by_constants: Tensor
    expected: Tensor
    begins: int = 0
    correlation: float = 0.0

    @property
    def samples(self) -> int:
        """Number of samples that the noise was learnt from."""
        return int(torch.isfinite(self.learnt).sum()) // self.learnt.shape[-1]

    @cached_property
    def transition(self) -> Tensor:
        """Transition matrix (D, D) of the levels, the random flows and the correlated noise of the sensors."""
        a, keep, noises = self.linear.transition, self.keep, self.linear.transition.new_zeros(self._noises)
        flows = keep * torch.eye(len(a), dtype=a.dtype)
        levels = torch.cat([torch.cat([a, forcing(a)], 1), torch.cat([torch.zeros_like(a), flows], 1)])
        return torch.block_diag(levels, torch.diag(noises + self.correlation))

    @property
    def _noises(self) -> int:
        """Number of sensors if their noise is correlated, and hence part of the filter's state; else 0."""
        return len(self.reading_std) if self.correlation else 0

    @property
    def white_std(self) -> Tensor:
        """Standard deviation (sensors,) of the white part of the measurement noise."""
        return (WHITE_SHARE if self.correlation else 1.0) * self.reading_std

    @property
    def keep(self) -> float:
        """Share of a flow that is left after one sampling interval."""
        return math.exp(-self.interval / self.noise.correlation_time) if self.noise.correlation_time else 0.0

    @property
    def flow_std(self) -> Tensor:
        """Standard deviation of each flow, (n,) m per sample."""
        return with_effects(self.noise.intensity, len(self.linear.transition))

    @property
    def process_std(self) -> Tensor:
        """Standard deviation of the shocks of states, flows and correlated noise in one interval, (D,)."""
        sigma, noise = self.flow_std, math.sqrt(1.0 - self.correlation**2) * self.reading_std[: self._noises]
        return torch.cat([0.0 * sigma, math.sqrt(1.0 - self.keep**2) * sigma, noise])

    @property
    def joint(self) -> Linear:
        """The linear model of all states of the filter: plant states, random flows and correlated sensor noise."""
        c = self.linear.output
        own = torch.eye(len(c), dtype=c.dtype)[:, : self._noises]
        return Linear(self.transition, torch.cat([c, torch.zeros_like(c), own], 1))

    @cached_property
    def gain(self) -> Gain:
        """Kalman gain from the first sample on, where the levels are still unknown, to its steady value."""
        levels = with_effects(self.start_std, len(self.linear.transition))
        start = torch.cat([levels, self.flow_std, self.reading_std[: self._noises]])
        return kalman_gain(self.joint, self.process_std, self.white_std, start)

    @cached_property
    def covariance(self) -> Tensor:
        """Steady covariance of the predicted state of the filter, (D, D)."""
        return riccati(self.joint, torch.diag(self.process_std**2), torch.diag(self.white_std**2))

    @property
    def innovation_std(self) -> Tensor:
        """Steady standard deviation (sensors,) of the innovations, in the readings' units."""
        h = self.joint.output
        return (torch.diagonal(h @ self.covariance @ h.mT) + self.white_std**2).sqrt()

    @cached_property
    def spectra(self) -> Tensor:
        """Amplitudes of the white, unit innovations by tank flows and sensor noise, (FREQUENCIES, sensors, P).

        They are T = H (z - F (1 - K H))^-1 q for the shocks q of a flow, and 1 - H (z - F (1 - K H))^-1 F K times the
        noise of a sensor, at z = exp(i w) of `_frequencies`. T T^H is the identity at each of them.
        """
        f, h, k = self.transition, self.joint.output, self.gain.steady
        tanks, n = len(self.noise.intensity), len(self.linear.transition)
        shocks = torch.diag(self.process_std)
        noise = shocks[:, 2 * n :] if self.correlation else -f @ k * self.reading_std
        sources = torch.cat([shocks[:, n : n + tanks], noise], dim=1)
        z = torch.exp(1j * _frequencies(f)).reshape(-1, 1, 1)
        errors = torch.linalg.solve(z * torch.eye(len(f), dtype=f.dtype) - (f - f @ k @ h), sources.to(z.dtype))
        amplitude = h.to(z.dtype) @ errors
        amplitude[:, :, tanks:] += 0.0 if self.correlation else torch.diag(self.reading_std)
        covariance = (amplitude @ amplitude.mH).real.mean(0)
        return torch.linalg.solve_triangular(torch.linalg.cholesky(covariance).to(z.dtype), amplitude, upper=False)

    @cached_property
    def _by_parameters(self) -> Tensor:
        """Derivatives of the log power of each source by the parameters, (FREQUENCIES, P, P + 1).

        The parameters are ln of the variances of flows and sensor noise, and the share `keep` of the flows, whose
        spectrum is proportional to (1 - a^2) / (1 - 2 a cos w + a^2).
        """
        a, cosine, tanks = self.keep, torch.cos(_frequencies(self.transition)), len(self.noise.intensity)
        by_keep = 2.0 * (cosine - a) / (1.0 - 2.0 * a * cosine + a * a) - 2.0 * a / (1.0 - a * a)
        sources = self.spectra.shape[-1]
        last = torch.cat([by_keep.unsqueeze(-1).expand(-1, tanks), by_keep.new_zeros(len(by_keep), sources - tanks)], 1)
        return torch.cat([torch.eye(sources, dtype=last.dtype).expand(len(last), -1, -1), last.unsqueeze(-1)], -1)

    @cached_property
    def covariance_of_parameters(self) -> Tensor:
        """Posterior covariance (P + 1, P + 1) of ln of the variances of flows and sensor noise, and of `keep`: inverse
        Fisher information.

        The information is that of a stationary series (Whittle 1953), samples / 2 times the mean over frequencies of
        |t_p^H t_q|^2 for sources p and q, and that of the prior of the flows' intensities.
        """
        t, by, tanks = self.spectra, self._by_parameters, len(self.noise.intensity)
        information = 0.5 * self.samples * (by.mT @ (t.mH @ t).abs().square() @ by).mean(0)
        eye = torch.eye(tanks, dtype=information.dtype)
        information[:tanks, :tanks] += (eye - 1.0 / tanks) / (2.0 * SCATTER) ** 2
        return torch.linalg.inv(information + torch.eye(len(information), dtype=eye.dtype) / (2.0 * LOG_BOUND) ** 2)

    def error_of_sums(self, length: int) -> Tensor:
        """Standard error (sensors,) of ln of the standard deviation of sums of `length` innovations.

        Computed by the delta method, for innovations that were scaled to unit variance over the recording.
        """
        power, half = self.spectra.abs().square() @ self._by_parameters, 0.5 * _frequencies(self.transition)
        of_sums = (torch.sin(length * half) / torch.sin(half)).square() / length
        slope = ((of_sums - 1.0).reshape(-1, 1, 1) * power).mean(0)
        return 0.5 * (slope @ self.covariance_of_parameters * slope).sum(-1).sqrt()

    def covariance_of_sums(self, rows: Tensor) -> Tensor:
        """Covariance (P, P) of P weighted sums of what random flows and measurement noise add to the readings of a free
        run, by the adjoint of the model. rows (P, S, sensors): the weights.
        """
        n = len(self.linear.transition)
        start = torch.cat([self.flow_std.new_zeros(n), self.flow_std, self.reading_std[: self._noises]])
        by_states, noise = rows.new_zeros(len(rows), len(self.transition)), (rows * self.white_std).flatten(1)
        total = noise @ noise.mT
        for k in range(rows.shape[1] - 1, -1, -1):
            shocks = by_states * self.process_std
            total = total + shocks @ shocks.mT
            by_states = by_states @ self.transition + rows[:, k] @ self.joint.output
        first = by_states * start
        return total + first @ first.mT

    def over(self, samples: int) -> tuple[Tensor, Tensor]:
        """Transition (2 n, 2 n) of states and flows over some samples, and covariance of their shocks, by doubling."""
        levels = slice(2 * len(self.linear.transition))
        step, shocks = self.transition[levels, levels], torch.diag(self.process_std[levels] ** 2)
        transition, total = torch.eye(len(step), dtype=step.dtype), torch.zeros_like(step)
        while samples:
            if samples % 2:
                transition, total = step @ transition, step @ total @ step.mT + shocks
            step, shocks, samples = step @ step, step @ shocks @ step.mT + shocks, samples // 2
        return transition, total

    def covariance_after(self, memory: Tensor) -> Tensor:
        """Covariance (D, D) of the state in a memory (G,): the steady one, unless readings were missing lately."""
        size = len(self.transition)
        packed, (row, column) = memory[size:], torch.tril_indices(size, size)
        if not bool(packed.any()):
            return self.covariance
        covariance = memory.new_zeros(size, size)
        covariance[row, column] = covariance[column, row] = packed
        return covariance

    @cached_property
    def _opening_covariances(self) -> Tensor:
        """Covariance (K, D, D) of the predicted state at the first samples, where the gain is not steady yet."""
        levels = with_effects(self.start_std, len(self.linear.transition))
        predicted = torch.diag(torch.cat([levels, self.flow_std, self.reading_std[: self._noises]]) ** 2)
        path, process = [predicted[:0].new_zeros(0, *predicted.shape)], torch.diag(self.process_std**2)
        for gain in self.gain.opening:
            path.append(predicted[None])
            corrected = predicted - gain @ self.joint.output @ predicted
            predicted = self.transition @ corrected @ self.transition.mT + process
        return torch.cat(path)

    def __call__(
        self, residual: Tensor, number: int = 0, memory: Tensor | None = None, states: bool = True
    ) -> tuple[Tensor, Tensor]:
        """Innovations (*batch, S, sensors) in the readings' units, and the filter's memory (*batch, S, G) after each
        sample: the state, that is, states (n), flows (n), and the noise of sensors if it is correlated; then the lower
        triangle of its covariance, 0 where that is the one without missing readings. Without `states`, G = 0.

        Beside missing readings the innovations are scaled, so that they keep the covariance of the steady state.
        residual (*batch, S, sensors): scaled to the steady variance (`Observation.steady_residual`). number: samples
        of the run before the first. memory (*batch, G): before the first sample, 0 where the filter starts.
        """
        batch, (count, channels) = residual.shape[:-2], residual.shape[-2:]
        size, lanes = len(self.transition), batch.numel()
        whole = size + size * (size + 1) // 2
        raw = (residual * self.observer.spread(number, count)).reshape(lanes, count, channels).contiguous()
        state = raw.new_zeros(whole) if memory is None or number == self.begins else memory
        state = state.expand(*batch, whole).reshape(lanes, whole).contiguous()
        out, path = torch.empty_like(raw), raw.new_empty(lanes, count, whole if states else 0)
        processed = number - self.begins
        opening = self._opening_covariances[processed : processed + count]
        fixed = [self.transition, self.joint.output, self.process_std**2, self.white_std**2, self.covariance, opening]
        tables = [self.gain.table(processed, count), self.gain.spread(processed, count)]
        given = [x.contiguous() for x in (*fixed, *tables, self.observer.table(number, count), raw, state)]
        pointers = [ctypes.c_void_p(x.data_ptr()) for x in (*given, out)]
        library = _library(len(self.linear.transition), channels, size)
        counts = (ctypes.c_int64(n) for n in (lanes, count, len(opening)))
        library.flow_filter(*counts, *pointers, ctypes.c_void_p(path.data_ptr() if states else None))
        return out.reshape(residual.shape), path.reshape(*batch, *path.shape[1:])


def forcing(transition: Tensor) -> Tensor:
    """States after one interval by flows held over it, (n, n): the trapezoidal rule for the mean of A(t)."""
    return 0.5 * (torch.eye(len(transition), dtype=transition.dtype) + transition)


def _frequencies(like: Tensor) -> Tensor:
    """Angular frequencies between 0 and pi, rad per sample."""
    return (torch.arange(FREQUENCIES, dtype=like.dtype) + 0.5) * math.pi / FREQUENCIES


@lru_cache
def _library(n: int, channels: int, size: int) -> ctypes.CDLL:
    """flow_filter.hpp compiled for these sizes."""
    source = Path(__file__).with_name("flow_filter.hpp").read_text(encoding="utf-8")
    library = load_library(f"#define N {n}\n#define C {channels}\n#define D {size}\n{source}", "flow_filter")
    library.flow_filter.restype = None
    return library
