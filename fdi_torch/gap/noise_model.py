"""The noise floor: level and AR(1) colour of each channel's noise from the fast part of its residuals, and lattices.

What a model gets wrong is slow beside the sampling, noise is not: the spectrum of an AR(1) noise and of a model's
error whose slope jumps (levels are integrals of flows),

    S(w) = s^2 (1 / |1 - a exp(-i w)|^2 + m / |1 - exp(-i w)|^4),

is fitted to the periodogram above a corner frequency only (Whittle, 1953), so that a gap does not pass for colour,
not even where the samples are so far apart that the error reaches beyond the corner. A transmitter that shows the mean
of its last n samples is told by the zeros of its spectrum: its kernel ends after n samples, where AR(1)'s goes on,

    1, a, a^2, ..., a^(n-1):   |1 - a^n exp(-i n w)|^2 / |1 - a exp(-i w)|^2,   a^n = 0.9,

which is as good as even, and can be undone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

DECAY_SHARE = 0.3  # of a rounding step, over which its error is forgotten
MOST_BINS = 512  # of a spectrum
KEPT = 2  # layouts whose spectra are kept, 40 MB each: a recording's, and its hold-out's
LEAST_SAMPLES = 20  # in a stretch that has a say in level and colour
FAST_PERIOD = 30.0  # samples; slower parts of a residual may be the model's


KEPT_OF_MEAN = 0.9  # a^n
LONGEST_MEAN = 16  # samples
MEAN_EARNS = 50.0  # twice the log-likelihood by which a mean has to be likelier than AR(1)
DOUBLINGS = 6  # of the undoing of a mean: 0.9^64 is nothing


@dataclass(frozen=True)
class Noise:
    """innovation (C,): standard deviation of what is new in each sample, in the reading's unit; ar (C,).

    mean_of: over how many samples what is new lasts; 0: for ever, AR(1). steps (C,): quantization step of each
    channel in the reading's unit, 0 where there is none; empty: none anywhere.
    """

    innovation: Tensor
    ar: Tensor
    mean_of: int = 0
    steps: tuple[float, ...] = ()

    @property
    def energy(self) -> Tensor:
        """Sum of the kernel's squares, (C,)."""
        last = self.ar ** (2 * self.mean_of) if self.mean_of else 0.0
        return (1.0 - last) / (1.0 - self.ar**2)

    @property
    def std(self) -> Tensor:
        return self.innovation * torch.sqrt(self.energy)

    @property
    def alike(self) -> Tensor:
        """Correlation of neighbouring samples, (C,)."""
        if not self.mean_of:
            return self.ar
        return self.ar * (1.0 - self.ar ** (2 * self.mean_of - 2)) / (1.0 - self.ar ** (2 * self.mean_of))

    @property
    def repeats(self) -> Tensor:
        """Samples that count as one where squares are summed: the sum of all squared correlations, (C,)."""
        if not self.mean_of:
            return (1.0 + self.ar**2) / (1.0 - self.ar**2)
        kernel = self.ar ** torch.arange(self.mean_of, dtype=self.ar.dtype).unsqueeze(1)
        power = torch.fft.rfft(kernel, n=2 * self.mean_of, dim=0).abs() ** 2
        return (torch.fft.irfft(power, n=2 * self.mean_of, dim=0) ** 2).sum(dim=0) / self.energy**2

    def whiten(self, x: Tensor, mask: Tensor) -> Tensor:
        """x (*lanes, S, C) or (*lanes, S, C, P), mask (S, C) -> independent samples of unit variance; masked are 0.

        x_k - a x_{k-1}; the first sample, and one after a masked one, is scaled by sqrt(1 - a^2) instead.
        Of a mean of n, what left it is added again: y_k = ... + a^n y_{k-n}.
        """
        columns = x.shape[-2:] != mask.shape
        wide = (lambda t: t.unsqueeze(-1)) if columns else (lambda t: t)
        ar, keep, time = wide(self.ar), wide(mask), -3 if columns else -2
        whole = bool(mask.all())
        scaled = (x if whole else torch.where(keep, x, 0.0)) / wide(self.innovation)
        if not bool((ar != 0.0).any()):
            return scaled
        count, fresh = x.shape[time], 1.0 / torch.sqrt(wide(self.energy))
        first, before = scaled.narrow(time, 0, 1), scaled.narrow(time, 0, count - 1)
        after = scaled.narrow(time, 1, count - 1)
        rest = after - ar * before
        if not whole:
            rest = torch.where(keep[1:], torch.where(keep[:-1], rest, fresh * after), 0.0)
        white = torch.cat([fresh * first, rest], dim=time)
        for turn in range(DOUBLINGS if self.mean_of else 0):
            lag = self.mean_of * 2**turn
            if lag < count:
                again = ar**lag * white.narrow(time, 0, count - lag)
                still, later = white.narrow(time, 0, lag), white.narrow(time, lag, count - lag)
                white = torch.cat([still, later + again], dim=time)
        return white if whole or not self.mean_of else torch.where(keep, white, 0.0)


def low_frequency_excess(white: Tensor) -> float:
    """What a whitened residual (S, C) holds below the corner frequency beyond what its fast part lets expect.

    In chi-square units. The fast part is the yardstick, so that an error of the noise's level does not count.
    """
    power = torch.fft.rfft(white, dim=0).abs() ** 2 * 2.0 / len(white)
    slow = torch.arange(len(power), dtype=white.dtype) / len(white) <= 1.0 / FAST_PERIOD
    power[0] *= 0.5
    level = power[~slow].mean(dim=0)
    return float((power[slow].sum(dim=0) - (float(slow.sum()) - 0.5) * level).sum())


def estimate_noise(
    residual: Tensor, mask: Tensor, steps: Sequence[float] = (), rows: Sequence[slice] = (slice(None),)
) -> Noise:
    """residual (S, C), mask (S, C) -> level and colour of each channel's noise.

    One colour for all channels: they are read by one system. steps (C,): quantization steps; channels that have one
    have no say in the colour, for the error of rounding has its own. rows: the stretches that follow each other
    without a jump.
    """
    rounded = [step > 0.0 for step in steps]
    spectra = [_spectrum_of_all([residual[r][mask[r][:, c], c] for r in rows]) for c in range(residual.shape[1])]
    say = [not r for r in rounded] if rounded and not all(rounded) else [True] * len(spectra)
    levels = [_levels(*s) for s in spectra]
    # (C, colours, errors)
    likelihoods = torch.stack([_likelihood(*s, x) for s, x in zip(spectra, levels, strict=True)])
    counts = [int(mask[:, c].sum()) for c in range(residual.shape[1])]
    likelihoods = likelihoods + torch.stack([_cost_of_error(n) for n in counts]).unsqueeze(1)
    likelihoods[:, len(_AR) :] += math.inf if any(rounded) else MEAN_EARNS
    best = likelihoods.min(dim=-1).values
    common = _chosen(best[torch.tensor(say)].sum(dim=0), int(mask.sum()))
    chosen = [common if ours else _chosen(best[c], counts[c]) for c, ours in enumerate(say)]
    errors = [int(x[i].argmin()) for x, i in zip(likelihoods, chosen, strict=True)]
    level = torch.stack([x[i, j] for x, i, j in zip(levels, chosen, errors, strict=True)])
    innovation = torch.sqrt(torch.clamp(level, min=torch.finfo(level.dtype).tiny))
    return Noise(innovation, _COLOURS.to(level)[torch.tensor(chosen)], int(_LASTING[common]), tuple(steps))


_AR = torch.cat([torch.linspace(-0.5, 0.9, 281), torch.linspace(0.901, 0.98, 80)])
_LENGTHS = torch.arange(2, LONGEST_MEAN + 1)  # of means, samples
_LASTING = torch.cat([torch.zeros(len(_AR), dtype=torch.long), _LENGTHS])  # samples; 0: for ever
_COLOURS = torch.cat([_AR, KEPT_OF_MEAN ** (1.0 / _LENGTHS)])
_WHITE = int(_COLOURS.abs().argmin())
_ERRORS = torch.cat([torch.zeros(1), torch.logspace(-4, 2, 25)])  # of the model, as shares of the innovation


Layout = tuple[tuple[int, int], ...]
"""Of which stretches a spectrum is put together: samples of each, and at most how many bins."""


def _spectrum_of_all(stretches: Sequence[Tensor]) -> tuple[Tensor, Layout, int]:
    """Spectra of several stretches side by side; too short ones have no say. Each bin is the mean of so many
    neighbours (the third item).
    """
    if len(stretches) == 1:
        power, width = _fast_spectrum(stretches[0], MOST_BINS)
        return power, ((len(stretches[0]), MOST_BINS),), width
    told = [x for x in stretches if len(x) >= LEAST_SAMPLES] or [max(stretches, key=len)]
    return torch.cat([_fast_spectrum(x, len(x))[0] for x in told]), tuple((len(x), len(x)) for x in told), 1


def _fast_spectrum(x: Tensor, bins: int) -> tuple[Tensor, int]:
    """Tapered periodogram of x (S,) above the corner frequency, in bins: spectra here are smooth."""
    taper = torch.hann_window(len(x), periodic=False, dtype=x.dtype)
    power = torch.fft.rfft((x - x.mean()) * taper).abs() ** 2 / (taper**2).sum()
    return _binned(power, len(x), bins)


def _binned(each: Tensor, count: int, bins: int) -> tuple[Tensor, int]:
    """What belongs to the frequencies of so many samples, above the corner frequency: the means of neighbours, and of
    how many.
    """
    fast = torch.arange(len(each), dtype=each.dtype) / count > 1.0 / FAST_PERIOD
    width = -(-int(fast.sum()) // bins)
    return each[fast][: int(fast.sum()) // width * width].reshape(-1, width).mean(dim=1), width


def _cosine(count: int, bins: int) -> Tensor:
    """Of the frequency of each bin."""
    frequency = torch.arange(count // 2 + 1, dtype=torch.float64) / count
    return torch.cos(2 * math.pi * _binned(frequency, count, bins)[0])


@dataclass(frozen=True)
class _Shapes:
    """Spectra of innovation 1 for each colour and error at some frequencies (F,): their inverses (colours, errors, F),
    and the mean of their logarithms (colours, errors).
    """

    inverse: Tensor
    mean_log: Tensor


@lru_cache(maxsize=KEPT)
def _shapes(layout: Layout) -> _Shapes:
    """Kept for the last few layouts: all channels of a recording, and its next estimate, have the same."""
    cosine = torch.cat([_cosine(count, bins) for count, bins in layout])
    a, error = _COLOURS.to(cosine).reshape(-1, 1, 1), _ERRORS.to(cosine).reshape(-1, 1)
    without_time_course = _LASTING.to(cosine).reshape(-1, 1, 1)
    gone = torch.where(without_time_course > 0, a**without_time_course, 0.0)
    ended = 1.0 - 2.0 * gone * torch.cos(without_time_course * torch.arccos(cosine.clamp(-1.0, 1.0))) + gone * gone
    shape = ended / (1.0 - 2.0 * a * cosine + a * a) + error / (2.0 - 2.0 * cosine) ** 2
    return _Shapes(1.0 / shape, torch.log(shape).mean(dim=-1))


def _levels(power: Tensor, layout: Layout, width: int) -> Tensor:
    """Innovation variance for each colour and error, (colours, errors)."""
    return (_shapes(layout).inverse @ power) / len(power)


def _likelihood(power: Tensor, layout: Layout, width: int, levels: Tensor) -> Tensor:
    """Twice the negative log-likelihood for each colour and error; the taper leaves one frequency in 1.94
    independent.
    """
    level = torch.log(torch.clamp(levels, min=torch.finfo(power.dtype).tiny))
    return 2.0 * (level + _shapes(layout).mean_log) * len(power) * width / 1.94


def _cost_of_error(count: int) -> Tensor:
    """Twice what the BIC asks for one more parameter: an error of the model that matters is worth far more."""
    return torch.where(_ERRORS > 0.0, 2.0 * math.log(count), 0.0)


def _chosen(likelihood: Tensor, count: int) -> int:
    """The likeliest colour; white unless colour earns what the BIC asks for one parameter."""
    best = int(likelihood.argmin())
    return best if float(likelihood[_WHITE] - likelihood[best]) > math.log(count) else _WHITE


def with_rounding(noise: Noise, steps: Sequence[float], readings: Tensor) -> Noise:
    """What rounding adds, for channels (C,) that are rounded to steps > 0; readings (S, C): about what they would read.

    A variance of step^2/12 (Widrow and Kollar, 2008) on that of the other channels. It stays the same until the level
    has moved by a good part of a step: its colour is that of the time which the level takes for it.
    """
    if not any(steps):
        return noise
    std, ar = noise.std.clone(), noise.ar.clone()
    plain = [float(s) for s, step in zip(std, steps, strict=True) if not step]
    for c, step in enumerate(steps):
        if not step:
            continue
        below = sorted(plain)[len(plain) // 2] if plain else 0.0
        moved = float(readings[:, c].diff().abs().mean())
        slow = math.exp(-max(moved, 1e-4 * step) / (DECAY_SHARE * step))
        std[c], ar[c] = math.hypot(below, step / math.sqrt(12.0)), max(float(ar[c]), min(slow, 0.98))
    return Noise(std * torch.sqrt(1.0 - ar**2), ar)


def quantization_step(values: Tensor, noise: float) -> float:
    """The distance between the values that a rounded channel takes, or 0 where it is finer than a tenth of the noise.

    values (S,). A lattice: all gaps between distinct values are multiples of the least one.
    """
    distinct = torch.unique(values)
    if len(distinct) < 3:
        return 0.0
    gaps = torch.diff(distinct)
    merged = gaps[gaps > 1e-9 * float(distinct.abs().max())]
    if len(merged) < 2:
        return 0.0
    step = float(merged.min())
    step = float(merged[merged < 1.5 * step].mean())
    multiples = merged / step
    on_lattice = bool(((multiples - multiples.round()).abs() < 0.02 * multiples.round()).all())
    return step if on_lattice and step > 0.1 * noise and len(distinct) < 0.5 * len(values) else 0.0
