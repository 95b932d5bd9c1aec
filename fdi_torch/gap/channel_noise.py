"""Noise model of the sensors: standard deviation, correlation and quantization step of each channel.

A model error is slow compared with the sampling, noise is not. The spectrum of AR(1) noise and of a model error whose
slope jumps (levels are integrals of flows),

    S(w) = s^2 (1 / |1 - a exp(-i w)|^2 + m / |1 - exp(-i w)|^4),

is fitted to the periodogram above a corner frequency (Whittle, 1953), so that a gap is not mistaken for correlated
noise, even if the samples are so far apart that the error reaches beyond the corner.

A transmitter that returns the mean of its last n samples has zeros in its spectrum. Its kernel ends after n samples:

    1, a, a^2, ..., a^(n-1):   |1 - a^n exp(-i n w)|^2 / |1 - a exp(-i w)|^2,   a^n = 0.9,

which is nearly constant, and can be inverted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

RELEVANT = 0.01  # share of the variance of the noise that rounding must add to be considered
DECAY_SHARE = 0.3  # share of a quantization step over which its error decorrelates
BINS = 512  # of all spectra, between the corner frequency and half of the sampling rate
LEAST_SAMPLES = 20  # in a segment that is used for the estimate
FAST_PERIOD = 30.0  # samples; slower parts of a residual may be model error
_CORNER = 1.0 / FAST_PERIOD  # frequency in cycles per sample

MEAN_DECAY = 0.9  # a^n
LONGEST_MEAN = 16  # samples of a moving average
MEAN_PENALTY = 50.0  # twice the log-likelihood by which a moving average must be likelier than AR(1)
DOUBLINGS = 6  # rounds in which a moving average is inverted: 0.9^64 is negligible


@dataclass(frozen=True)
class Noise:
    """innovation (C,): standard deviation of the innovations, in the reading's unit. ar (C,): AR(1) coefficient.

    mean_of: length of a moving average in samples; 0 for AR(1). steps (C,): quantization step of each channel in the
    reading's unit, 0 if there is none; empty: none at all.
    """

    innovation: Tensor
    ar: Tensor
    mean_of: int = 0
    steps: tuple[float, ...] = ()

    @staticmethod
    def white(std: Tensor) -> Noise:
        """White noise with standard deviations std (C,)."""
        return Noise(std, torch.zeros_like(std))

    @staticmethod
    def rough(readings: Tensor) -> Noise:
        """White noise for a first fit to readings (S, C): a hundredth of their standard deviation."""
        return Noise.white(1e-2 * readings.nan_to_num().std(dim=0).clamp(min=1e-9))

    @property
    def energy(self) -> Tensor:
        """Variance of the noise divided by that of its innovations, (C,)."""
        last = self.ar ** (2 * self.mean_of) if self.mean_of else 0.0
        return (1.0 - last) / (1.0 - self.ar**2)

    @property
    def std(self) -> Tensor:
        return self.innovation * torch.sqrt(self.energy)

    def at_least(self, std: Tensor) -> Noise:
        """The noise with standard deviations of at least std (C,)."""
        return replace(self, innovation=torch.maximum(self.innovation, std / torch.sqrt(self.energy)))

    @property
    def lag_one(self) -> Tensor:
        """Correlation of neighbouring samples, (C,)."""
        if not self.mean_of:
            return self.ar
        return self.ar * (1.0 - self.ar ** (2 * self.mean_of - 2)) / (1.0 - self.ar ** (2 * self.mean_of))

    @property
    def squared_correlations(self) -> Tensor:
        """Sum of all squared correlations, (C,): samples that count as one where squares are summed."""
        if not self.mean_of:
            return (1.0 + self.ar**2) / (1.0 - self.ar**2)
        kernel = self.ar ** torch.arange(self.mean_of, dtype=self.ar.dtype).unsqueeze(1)
        power = torch.fft.rfft(kernel, n=2 * self.mean_of, dim=0).abs() ** 2
        return (torch.fft.irfft(power, n=2 * self.mean_of, dim=0) ** 2).sum(dim=0) / self.energy**2

    def whiten(self, x: Tensor, mask: Tensor) -> Tensor:
        """x (*lanes, S, C) or (*lanes, S, C, P), mask (S, C) -> independent samples of unit variance; masked samples
        are 0.

        x_k - a x_{k-1}; the first sample, and one after a masked sample, is divided by its standard deviation instead.
        For a moving average of n, the sample that left it is added again: y_k = ... + a^n y_{k-n}.
        """
        columns, whole = x.shape[-2:] != mask.shape, bool(mask.all())
        broadcast = (lambda t: t.unsqueeze(-1)) if columns else (lambda t: t)
        time, count = -3 if columns else -2, len(mask)
        keep, follows, own = broadcast(mask), _follows(mask), mask / self._divisors(mask)
        known = x if whole else torch.where(keep, x, 0.0)
        white = known * broadcast(own)
        if not bool((self.ar != 0.0).any()):
            return white
        before = broadcast(-self.ar * own * follows)[1:]
        white.narrow(time, 1, count - 1).addcmul_(known.narrow(time, 0, count - 1), before)
        for doubling in range(DOUBLINGS if self.mean_of else 0):
            lag = self.mean_of * 2**doubling
            if lag < count:
                returned = broadcast(self.ar**lag) * white.narrow(time, 0, count - lag)
                white.narrow(time, lag, count - lag).add_(returned)
        return white if whole or not self.mean_of else torch.where(keep, white, 0.0)

    def log_det(self, mask: Tensor) -> float:
        """Log determinant of the covariance that `whiten` reduces to the identity, over all valid samples."""
        return 2.0 * float(torch.log(self._divisors(mask))[mask].sum())

    def _divisors(self, mask: Tensor) -> Tensor:
        """Standard deviation (S, C) of each sample, given the one before it if that is valid."""
        return torch.where(_follows(mask), self.innovation, self.std)


def _follows(mask: Tensor) -> Tensor:
    """Samples (S, C) after a valid one."""
    return torch.cat([torch.zeros_like(mask[:1]), mask[:-1]])


def low_frequency_excess(white: Tensor) -> float:
    """Chi-square of a whitened residual (S, C) below the corner frequency, beyond what its high frequencies predict.

    The level is that of the high frequencies, so that a wrong noise level does not count.
    """
    power = torch.fft.rfft(white, dim=0).abs() ** 2 * 2.0 / len(white)
    slow = torch.arange(len(power), dtype=white.dtype) / len(white) <= 1.0 / FAST_PERIOD
    power[0] *= 0.5
    level = power[~slow].mean(dim=0)
    return float((power[slow].sum(dim=0) - (float(slow.sum()) - 0.5) * level).sum())


def estimate_noise(residual: Tensor, mask: Tensor, rows: Sequence[slice], steps: Sequence[float] = ()) -> Noise:
    """Estimate the noise of each channel from residual (S, C) and mask (S, C).

    All channels share one correlation, since one system reads them. rows: those of each recording, because the model
    error jumps between recordings. steps (C,): quantization steps; channels with a step do not count for the common
    correlation, because rounding errors have their own.
    """
    quantized = [step > 0.0 for step in steps]
    channels = range(residual.shape[1])
    spectra = [_spectrum([residual[r][mask[r][:, c], c] for r in rows]) for c in channels]
    plain = [not r for r in quantized] if quantized and not all(quantized) else [True] * len(spectra)
    levels, likelihoods = _fitted(*map(torch.stack, zip(*spectra, strict=True)))  # (C, correlations, errors)
    counts = [int(mask[:, c].sum()) for c in channels]
    likelihoods = likelihoods + torch.stack([_cost_of_error(n) for n in counts]).unsqueeze(1)
    likelihoods[:, len(_AR) :] += math.inf if any(quantized) else MEAN_PENALTY
    best = likelihoods.min(dim=-1).values
    common = _most_likely(best[torch.tensor(plain)].sum(dim=0), int(mask.sum()))
    chosen = [common if is_plain else _most_likely(best[c], counts[c]) for c, is_plain in enumerate(plain)]
    errors = [int(x[i].argmin()) for x, i in zip(likelihoods, chosen, strict=True)]
    level = torch.stack([x[i, j] for x, i, j in zip(levels, chosen, errors, strict=True)])
    innovation = torch.sqrt(torch.clamp(level, min=torch.finfo(level.dtype).tiny))
    return Noise(innovation, _CORRELATIONS.to(level)[torch.tensor(chosen)], int(_MEAN_LENGTHS[common]), tuple(steps))


# Divided, so that white noise is exactly 0: with a correlation of 1e-8, the Kalman filter has a state for each sensor.
_AR = torch.cat([torch.arange(-100, 181) / 200, torch.linspace(0.901, 0.98, 80)])
_LENGTHS = torch.arange(2, LONGEST_MEAN + 1)  # of means, samples
_MEAN_LENGTHS = torch.cat([torch.zeros(len(_AR), dtype=torch.long), _LENGTHS])  # samples; 0: for ever
_CORRELATIONS = torch.cat([_AR, MEAN_DECAY ** (1.0 / _LENGTHS)])
_WHITE = int(_CORRELATIONS.abs().argmin())
_ERRORS = torch.cat([torch.zeros(1), torch.logspace(-4, 2, 25)])  # of the model, as shares of the innovation


def _spectrum(segments: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Sum of the tapered periodograms of segments (S,) in each bin above the corner frequency, and number of summands,
    (BINS,) both.

    Segments that are too short are left out.
    """
    total = segments[0].new_zeros(2, BINS)
    for x in [x for x in segments if len(x) >= LEAST_SAMPLES] or [max(segments, key=len)]:
        taper = torch.hann_window(len(x), periodic=False, dtype=x.dtype)
        power = torch.fft.rfft((x - x.mean()) * taper).abs() ** 2 / (taper**2).sum()
        position = (torch.arange(len(power), dtype=x.dtype) / len(x) - _CORNER) / (0.5 - _CORNER) * BINS
        fast = position > 0.0
        bins = position[fast].to(torch.int64).clamp(max=BINS - 1)
        total.index_add_(1, bins, torch.stack([power[fast], torch.ones_like(power[fast])]))
    return total[0], total[1]


@cache
def _shapes() -> tuple[Tensor, Tensor]:
    """Inverse and logarithm of the spectra with unit innovation, (correlations, errors, BINS), 40 MB each."""
    middle = (torch.arange(BINS, dtype=torch.float64) + 0.5) / BINS
    cosine = torch.cos(2 * math.pi * (_CORNER + (0.5 - _CORNER) * middle))
    a, error = _CORRELATIONS.to(cosine).reshape(-1, 1, 1), _ERRORS.to(cosine).reshape(-1, 1)
    lengths = _MEAN_LENGTHS.to(cosine).reshape(-1, 1, 1)
    remainder = torch.where(lengths > 0, a**lengths, 0.0)
    numerator = 1.0 - 2.0 * remainder * torch.cos(lengths * torch.arccos(cosine)) + remainder * remainder
    shape = numerator / (1.0 - 2.0 * a * cosine + a * a) + error / (2.0 - 2.0 * cosine) ** 2
    return 1.0 / shape, torch.log(shape)


def _fitted(power: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Innovation variance, and twice the negative log-likelihood with it, for each correlation and model error:
    (C, correlations, errors) both. power, counts (C, BINS): spectra of the channels.

    The Hann window correlates neighbouring frequencies, so that N of them count as N / 1.94 independent ones.
    """
    (inverse, logarithm), total = _shapes(), counts.sum(dim=1)
    level, mean_log = (table @ x.T / total for table, x in ((inverse, power), (logarithm, counts)))
    cost = 2.0 * (torch.log(level.clamp(min=torch.finfo(level.dtype).tiny)) + mean_log) * total / 1.94
    return level.movedim(-1, 0), cost.movedim(-1, 0)


def _cost_of_error(count: int) -> Tensor:
    """Twice the BIC penalty of one more parameter; a relevant model error gains far more."""
    return torch.where(_ERRORS > 0.0, 2.0 * math.log(count), 0.0)


def _most_likely(likelihood: Tensor, count: int) -> int:
    """Index of the likeliest correlation; white unless the gain exceeds the BIC penalty of one parameter."""
    best = int(likelihood.argmin())
    return best if float(likelihood[_WHITE] - likelihood[best]) > math.log(count) else _WHITE


def with_rounding(noise: Noise, steps: Sequence[float], readings: Tensor, gains: Tensor) -> Noise:
    """Add the rounding error of channels (C,) with steps > 0. readings (S, C): close to the readings before rounding.

    Its variance is step^2 / 12 (Widrow and Kollar, 2008), added to the noise of the other channels, which is assumed to
    be the same in metres. It is constant until the level has moved by a good part of a step, which gives its
    correlation. gains (C,): of the sensors, in the reading's unit per metre.
    """
    if not any(steps):
        return noise
    std, ar = noise.std.clone(), noise.ar.clone()
    in_metres = (std / gains.abs()).tolist()
    unrounded = sorted(s for s, step in zip(in_metres, steps, strict=True) if not step)
    noise_level = unrounded[len(unrounded) // 2] if unrounded else 0.0
    for c, step in enumerate(steps):
        if not step:
            continue
        movement = float(readings[:, c].diff().abs().mean())
        correlation = math.exp(-max(movement, 1e-4 * step) / (DECAY_SHARE * step))
        std[c] = math.hypot(noise_level * float(gains[c]), step / math.sqrt(12.0))
        ar[c] = max(float(ar[c]), min(correlation, 0.98))
    return Noise(std * torch.sqrt(1.0 - ar**2), ar)


def quantization_step(values: Tensor, noise: float) -> float:
    """Distance between the values of a quantized channel, or 0 if rounding adds less than a hundredth to the variance
    of the noise: it then costs less than a hundredth of the information.

    values (S,) are quantized if all differences between distinct values are multiples of the smallest one.
    """
    distinct = torch.unique(values)
    if len(distinct) < 3:
        return 0.0
    differences = torch.diff(distinct)
    clear = differences[differences > 1e-9 * float(distinct.abs().max())]
    if len(clear) < 2:
        return 0.0
    step = float(clear.min())
    step = float(clear[clear < 1.5 * step].mean())
    multiples = clear / step
    are_multiples = bool(((multiples - multiples.round()).abs() < 0.02 * multiples.round()).all())
    is_relevant = step**2 / 12.0 > RELEVANT * noise**2
    return step if are_multiples and is_relevant and len(distinct) < 0.5 * len(values) else 0.0
