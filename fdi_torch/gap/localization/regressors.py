"""Candidate regressors of a discrepancy: signals along a recording, many more than a discrepancy needs.

- Functions of a local variable: constant, linear, smooth, and steps.
- Functions with memory: lags, delays, backlash, stiction, rate limits, relays, decays after a change.
- Functions of time: steps, ramps, sinusoids, and periodic pulses (`regressor_families.py`).

None looks ahead: a predicted level depends on all earlier readings, and their noise would explain itself.

Times are those of three_tank; `scale` multiplies them for other plants (`plant.scales.time_scale`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from fdi_torch.simulate.resampling import interpolate
from fdi_torch.simulate.scan import scan_in_time

LAGS = (3.0, 10.0, 30.0, 100.0, 300.0)  # time constants, s
DELAYS = (4.0, 8.0, 16.0, 32.0)  # s; neighbours together make a delay between them
DECAY_TIMES = (10.0, 40.0, 160.0)  # s, of the decay after a step up or down
BACKLASH_BANDS = (0.03, 0.08, 0.16, 0.3)  # backlash, as shares of the signal's range
BACKLASH_STARTS = (-1.0, 0.0, 1.0)  # what moved before the recording rests at an end of its band
STICTION_BANDS = (0.1, 0.2, 0.3, 0.4)  # as shares of the signal's range
FINE_STICTION_BANDS = tuple(0.005 * j for j in range(2, 101))  # the output is no continuous function of the band
TRAVEL_TIMES = (8.0, 20.0, 40.0, 80.0, 160.0, 320.0)  # s, through the full range at the rate limit
FATIGUE_TIMES = (150.0, 500.0)  # s, of the mean of a flow's recent past that changes it
RAMPS = 12  # ramps in time, at equal distances
CYCLES = 8  # fewest periods in a recording of a line that its spectrum shows
SLOW_CYCLES = tuple(1.0 + 0.25 * j for j in range(4 * (CYCLES - 1)))  # periods of slower sinusoids
STEPS = 120  # maximum number of step functions of time, over all recordings
SAMPLES_A_STEP = 9  # fewest samples per step function of time
HARMONICS = 3  # of a dominant frequency of the residual


def smooth_function(x: Tensor, ends: tuple[float, float], count: int) -> list[Tensor]:
    """1, x - low, and max(x - c, 0) for `count` - 2 values c between the ends, (count - 2, K).

    The last have coefficients of a common variance, so that their sum is an integrated random walk, whose most likely
    course is a smoothing spline (Wahba, 1978).
    """
    at = torch.linspace(*ends, count, dtype=x.dtype)[1:-1]
    return [torch.ones_like(x), x - ends[0], (x - at.unsqueeze(1)).clamp(min=0.0)]


def steps_in_value(x: Tensor, ends: tuple[float, float], count: int) -> list[Tensor]:
    """Whether x is at least c, for `count` values c between the ends."""
    return [(x >= c).to(x.dtype) for c in torch.linspace(*ends, count + 2, dtype=x.dtype).tolist()[1:-1]]


def lags_and_decays(x: Tensor, step: Tensor, scale: float) -> list[Tensor]:
    """Difference between lagged or delayed x and x, and decays after each rise and fall of x."""
    change = torch.diff(x, prepend=x[:1])
    rises, falls = change.clamp(min=0.0), (-change).clamp(min=0.0)
    lagging = [lagged(x, step, scale * tau) - x for tau in LAGS]
    lagging += [delayed(x, step, scale * tau) - x for tau in DELAYS]
    decays = [decayed(y, step, scale * tau) for tau in DECAY_TIMES for y in (rises, falls)]
    return [*lagging, *decays]


def finer(values: Sequence[float], factor: int) -> list[float]:
    """The values (ascending) and `factor` - 1 at equal ratios between neighbours."""
    between = [a * (b / a) ** (j / factor) for a, b in itertools.pairwise(values) for j in range(factor)]
    return [*between, values[-1]]


def backlashes(
    x: Tensor,
    ends: tuple[float, float],
    bands: Sequence[float] = BACKLASH_BANDS,
    starts: Sequence[float] = (0.0,),
) -> list[Tensor]:
    """Difference between x after a backlash and x, for each band and start."""
    band, start = torch.cartesian_prod(x.new_tensor(bands), x.new_tensor(starts)).split(1, dim=1)
    return list((backlash(x, band * (ends[1] - ends[0]), start) - x).unbind())


def rate_limits(
    x: Tensor, step: Tensor, ends: tuple[float, float], scale: float, times: Sequence[float] = TRAVEL_TIMES
) -> list[Tensor]:
    """Difference between x after a rate limit and x, for each travel time."""
    rate = (ends[1] - ends[0]) / (scale * x.new_tensor(times).unsqueeze(1))
    return list((rate_limited(x, step, rate) - x).unbind())


def stictions(x: Tensor, ends: tuple[float, float], bands: Sequence[float] = STICTION_BANDS) -> list[Tensor]:
    """Difference between x after stiction and x, for each band."""
    band = x.new_tensor(bands).unsqueeze(1) * (ends[1] - ends[0])
    return list((stiction(x, band) - x).unbind())


def relay_thresholds(ends: tuple[float, float], count: int) -> Tensor:
    """All pairs of `count` thresholds between the ends, the lower one first: (N, 2)."""
    width = (ends[1] - ends[0]) / count
    at = ends[0] + width * (torch.arange(count, dtype=torch.float64) + 0.5)
    return torch.combinations(at)


def fatigues(x: Tensor, step: Tensor, ends: tuple[float, float], scale: float) -> list[Tensor]:
    """Efficiency that falls with recent use: x times its own recent mean, over the largest |x|."""
    largest = max(abs(ends[0]), abs(ends[1]), 1e-12)
    return [x * lagged(x, step, scale * tau) / largest for tau in FATIGUE_TIMES]


def step_functions(samples: int, recordings: int) -> int:
    """Number of step functions of time in each recording. samples: of all recordings together."""
    return max(min(STEPS, samples // SAMPLES_A_STEP) // recordings, 2)


def time_functions(time: Tensor, duration: float, steps: int) -> list[Tensor]:
    """1, steps and ramps of time."""
    stepped = [(time >= duration * j / steps).to(time.dtype) for j in range(1, steps)]
    ramps = [(time / duration - j / RAMPS).clamp(min=0.0) for j in range(RAMPS)]
    return [torch.ones_like(time), *stepped, *ramps]


def harmonics(time: Tensor, frequency: Tensor) -> Tensor:
    """Sinusoids of time (K,) with multiples of each frequency (F,), Hz: (F, 2 HARMONICS, K)."""
    multiples = torch.arange(1, HARMONICS + 1, dtype=time.dtype)
    phase = 2.0 * math.pi * frequency[:, None, None] * multiples[:, None] * time
    return torch.cat([torch.sin(phase), torch.cos(phase)], dim=1)


def lagged(x: Tensor, step: Tensor, tau: float) -> Tensor:
    """First-order lag of x (K,), initially at rest, at the end of each step."""
    keep = torch.exp(-step / tau)
    return _scanned(keep, (1.0 - keep) * x, x[0])


def delayed(x: Tensor, step: Tensor, tau: float) -> Tensor:
    """x (K,) as it was tau seconds before, initially at rest."""
    times = torch.cumsum(step, dim=0)
    return interpolate(times - tau, times, x)


def decayed(x: Tensor, step: Tensor, tau: float) -> Tensor:
    """Sum of the inputs x (K,), each decaying exponentially from its step on."""
    return _scanned(torch.exp(-step / tau), x, torch.zeros_like(x[0]))


def backlash(x: Tensor, band: Tensor, start: Tensor | float = 0.0) -> Tensor:
    """Play operator: the output (B, K) follows x (K,) when x is more than the band (B, 1) away.

    start (B, 1): distance of the output from x before the first step, in bands. Each step clamps the output to
    [x - band, x + band]. The composition of clamps is a clamp, so that all steps are composed in log2(K) rounds.
    """
    low, high = x - band, x + band
    reach = 1
    while reach < x.shape[-1]:
        now_low, now_high = low[:, reach:], high[:, reach:]
        low, high = (
            torch.cat([y[:, :reach], torch.minimum(torch.maximum(y[:, :-reach], now_low), now_high)], dim=1)
            for y in (low, high)
        )
        reach *= 2
    return torch.minimum(torch.maximum(x[0] + start * band, low), high)


def stiction(x: Tensor, band: Tensor) -> Tensor:
    """Stiction: the output (B, K) holds its value until x (K,) is more than the band (B, 1) away, then jumps to x."""
    values, index = torch.unique_consecutive(x, return_inverse=True)
    bands = band.squeeze(1).numpy()
    output = np.empty((len(values), len(bands)))
    held = np.full(len(bands), float(x[0]))
    for k, value in enumerate(values.tolist()):
        held[np.abs(value - held) > bands] = value
        output[k] = held
    return torch.from_numpy(output).T[:, index]


def relay(x: Tensor, thresholds: Tensor) -> Tensor:
    """Whether relays with hysteresis are on, (N, K): from where x (K,) exceeds the upper threshold until it falls below
    the lower one. thresholds (N, 2): the lower and the upper one of each."""
    low, high = thresholds[:, :1], thresholds[:, 1:]
    switched = (x > high) | (x < low)
    switched[:, 0] = True
    last_switch = torch.where(switched, torch.arange(len(x)), 0).cummax(dim=1).values
    return x[last_switch] > 0.5 * (low + high)


def rate_limited(x: Tensor, step: Tensor, rate: Tensor) -> Tensor:
    """The output (B, K) follows x (K,) with at most `rate` (B, 1) per second, initially at rest.

    While x is constant, the output approaches it in a straight line, so that the loop is over the changes of x.
    """
    values, index, counts = torch.unique_consecutive(x, return_inverse=True, return_counts=True)
    time, last = torch.cumsum(step, dim=0), torch.cumsum(counts, dim=0) - 1
    durations = torch.diff(time[last], prepend=time.new_zeros(1))
    before = np.empty((len(values), len(rate)))  # output before each change
    held, rates = np.full(len(rate), float(x[0])), rate.squeeze(1).numpy()
    for k, (value, duration) in enumerate(zip(values.tolist(), durations.tolist(), strict=True)):
        before[k] = held
        most = rates * duration
        held = held + np.clip(value - held, -most, most)
    start = torch.from_numpy(before).T[:, index]
    most = rate * (time - (time[last] - durations)[index])
    return start + torch.minimum(torch.maximum(x - start, -most), most)


def _scanned(keep: Tensor, added: Tensor, first: Tensor) -> Tensor:
    shape = (1, 1, 1, -1)
    return scan_in_time(keep.reshape(shape), added.reshape(shape), first.reshape(1, 1, 1))[0, 0, 0, 1:]


ZERO_PADDING = 4  # factor by which the spectrum is interpolated
SURROUNDINGS = 15  # frequencies of the recording to each side, for the median


def likely_frequencies(white: Tensor, rows: Sequence[slice], spacing: float, duration: float) -> list[float]:
    """Frequencies (Hz) of sinusoids and pulses that a whitened residual (S, C) may contain.

    These are the frequency of the highest line of its spectrum, whole fractions of it (the line may be a harmonic), and
    lower frequencies, whose lines random flows may hide.

    rows: of each recording. spacing: of the samples, s. duration: of the longest recording, s.
    """
    dominant = dominant_frequency(white, rows, spacing)
    lines = [] if dominant is None else [dominant / harmonic for harmonic in range(1, HARMONICS + 1)]
    return [*lines, *(cycles / duration for cycles in SLOW_CYCLES)]


def dominant_frequency(white: Tensor, rows: Sequence[slice], spacing: float) -> float | None:
    """Frequency (Hz) of the strongest line in the spectrum of a whitened residual (S, C), or None.

    A line is measured against the median of its surroundings in the tapered periodogram, summed over the channels and
    the recordings, whose phases are independent.
    """
    samples = max(r.stop - r.start for r in rows)
    power = white.new_zeros(ZERO_PADDING * samples // 2 + 1)
    for x in (white[r] for r in rows):
        tapered = x * torch.hann_window(len(x), periodic=False, dtype=white.dtype).unsqueeze(-1)
        power += (torch.fft.rfft(tapered, n=ZERO_PADDING * samples, dim=0).abs() ** 2).sum(dim=-1)
    if len(power) < 2 * SURROUNDINGS * ZERO_PADDING:
        return None
    width = 2 * SURROUNDINGS * ZERO_PADDING + 1
    padded = torch.nn.functional.pad(power.reshape(1, 1, -1), (width // 2, width // 2), mode="reflect")[0, 0]
    median = padded.unfold(0, width, ZERO_PADDING)[:, ::ZERO_PADDING].median(dim=-1).values
    ratio = power / median.repeat_interleave(ZERO_PADDING)[: len(power)]
    ratio[: CYCLES * ZERO_PADDING] = 0.0
    peak = int(ratio.argmax())
    return peak / (ZERO_PADDING * samples * spacing) if peak else None
