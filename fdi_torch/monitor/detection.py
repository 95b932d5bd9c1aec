"""Detectors on white residuals: fixed threshold, CUSUM and GLR, held to a wished time between false alarms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.monitor.run_length import cusum_run_length, cusum_threshold, fixed_threshold, highest, threshold_of
from fdi_torch.monitor.whitening import Whitening

Chart = Literal["fixed", "cusum", "glr"]
CHARTS: tuple[Chart, ...] = ("fixed", "cusum", "glr")

# CUSUM's drift: half the shift, in standard deviations of the white residual, that is to be found soonest.
DRIFT = 0.5
LONGEST_WINDOW = 200
MOST_MORE = 3.0
NEVER = -1


@dataclass(frozen=True)
class Detector:
    """A statistic of white residuals (*batch, S, C) -> (*batch, S), and the threshold it is held against.

    follow: the same sample by sample, (S, C) and what it remembers of the samples before (None at a start) -> (S,) and
    what it then remembers; to the last bit the same however many samples come at once.
    """

    chart: str
    statistic: Callable[[Tensor], Tensor]
    threshold: float
    follow: Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]

    def shares(self, white: Tensor) -> Tensor:
        """The share (C,) of each channel in the statistic at the last sample of white residuals (S, C)."""
        alone = torch.eye(white.shape[-1], dtype=torch.bool).unsqueeze(1)
        each = self.statistic(torch.where(alone, white, 0.0))[:, -1].clamp(min=0.0)
        return each / each.sum().clamp(min=1e-300)

    def first_alarm(self, white: Tensor) -> Tensor:
        """Index of the first sample above the threshold, (*batch); NEVER where there is none."""
        above = self.statistic(white) > self.threshold
        first = above.to(torch.int8).argmax(dim=-1)
        return torch.where(above.any(dim=-1), first, torch.full_like(first, NEVER))

    def first_from(self, white: Tensor, since: Tensor) -> tuple[Tensor, Tensor]:
        """Index of the first alarm at or after sample `since` (*batch), NEVER where there is none, and how many came
        before it, after each of which the detector starts afresh; both (*batch).
        """
        rest = torch.nan_to_num(white, nan=0.0)
        index = torch.arange(rest.shape[-2], device=rest.device)
        early = torch.zeros_like(since)
        while True:
            first = self.first_alarm(rest)
            before = (first != NEVER) & (first < since)
            if not bool(before.any()):
                return first, early
            early = early + before
            seen = before.unsqueeze(-1) & (index <= first.unsqueeze(-1))
            rest = torch.where(seen.unsqueeze(-1), 0.0, rest)

    def alarms(self, white: Tensor) -> Tensor:
        """(*batch, S), True where an alarm is raised. After each the detector starts afresh with the next sample."""
        rest = torch.nan_to_num(white, nan=0.0)
        index = torch.arange(rest.shape[-2], device=rest.device)
        found = torch.zeros(rest.shape[:-1], dtype=torch.bool, device=rest.device)
        while True:
            first = self.first_alarm(rest).unsqueeze(-1)
            if not bool((first != NEVER).any()):
                return found
            found = found | (index == first)
            rest = torch.where((index <= first).unsqueeze(-1), torch.zeros_like(rest), rest)


def make_detector(
    chart: Chart,
    time_between_false_alarms: float,
    sampling: float,
    channels: int,
    generator: torch.Generator,
    drift: float = DRIFT,
    window: int = LONGEST_WINDOW,
    learnt: Whitening | None = None,
    peaks: Tensor | None = None,
) -> Detector:
    """A detector whose mean time between false alarms, all channels taken together, is the requested one (s).

    sampling: s between samples. drift: of the CUSUM. window: the longest of the GLR, in samples. learnt: what whitens
    the residual, known no better than its recording allows: then as many false alarms are expected as asked
    for in the mean over such recordings. peaks: of the GLR, where they have been simulated. Raises ValueError.
    """
    run_length = time_between_false_alarms / sampling
    if learnt is not None:
        run_length *= more_alarms(chart, run_length, channels, drift, learnt)
    if chart == "fixed":
        threshold = fixed_threshold(run_length, channels)
        return Detector(chart, largest, threshold, lambda e, before: (largest(e), e[:0]))
    if chart == "cusum":
        if not drift > 0:
            raise ValueError(f"expected a positive drift of the CUSUM, got {drift}")
        threshold = cusum_threshold(run_length, channels, drift)
        return Detector(chart, lambda e: cusum(e, drift), threshold, lambda e, before: cusum_on(e, drift, before))
    if chart == "glr":
        lengths = window_lengths(window)

        def statistic(white: Tensor) -> Tensor:
            return glr(white, lengths)

        peaks = highest(statistic, channels, generator) if peaks is None else peaks
        return Detector(chart, statistic, threshold_of(peaks, run_length), lambda e, before: glr_on(e, lengths, before))
    raise ValueError(f"expected a detector of {', '.join(CHARTS)}, got '{chart}'")


def more_alarms(chart: str, run_length: float, channels: int, drift: float, learnt: Whitening) -> float:
    """How many more false alarms a detector raises in the mean over recordings that its noise may be learnt from.

    Its rate grows as exp(s d) with an error d of ln of the residual's standard deviation, s = 10 to 25, so that an
    error with the variance v costs a factor exp(s^2 v / 2). Beyond MOST_MORE, which a few hundred samples of coloured
    noise reach, the mean is that of rare recordings, and no threshold would serve.
    """
    steep, variance = _steepness(chart, run_length, channels, drift, learnt)
    if chart == "glr":
        # The direction of a chance excess is any: E sum u^4 = 3 / (C + 2).
        variance = variance * 3.0 / (channels + 2.0)
    return min(float(torch.exp(0.5 * steep**2 * variance).mean()), MOST_MORE)


def rate_error(chart: str, run_length: float, channels: int, drift: float, learnt: Whitening) -> float:
    """Standard error of ln of the rate of false alarms that one such recording leaves: s sqrt(v / C), for the channels
    err each by itself and their alarms add.
    """
    steep, variance = _steepness(chart, run_length, channels, drift, learnt)
    return float(steep * (variance.mean() / channels).sqrt())


def _steepness(chart: str, run_length: float, channels: int, drift: float, learnt: Whitening) -> tuple[float, Tensor]:
    """d ln rate / d ln of the residual's standard deviation, and the variance of the latter's error by channel."""
    if chart == "fixed":
        fast = learnt.slow_error.new_full((channels,), learnt.fast_error**2)
        return fixed_threshold(run_length, channels) ** 2, fast
    if chart == "cusum":
        threshold, change = cusum_threshold(run_length, channels, drift), 1.01
        longer = cusum_run_length(threshold, drift) / cusum_run_length(threshold / change, drift / change)
        return math.log(longer) / math.log(change), learnt.slow_error**2
    # Of windows of n samples |sum e|^2 / n, chi-square of C channels, exceeds h as exp(-h / 2); h is about that of the
    # largest of run_length such.
    return 2.0 * math.log(run_length), learnt.slow_error**2


def largest(white: Tensor) -> Tensor:
    """max over channels of |e|, (*batch, S, C) -> (*batch, S)."""
    return torch.nan_to_num(white, nan=0.0).abs().amax(dim=-1)


def cusum(white: Tensor, drift: float) -> Tensor:
    """The highest of 2 C one-sided sums g = max(0, g +- e - drift) (Page 1954), as a sum less its running minimum.

    A missing reading changes none: a sensor that is read rarely would else never gather what its readings show.
    """
    sums = torch.cumsum(torch.nan_to_num(torch.cat([white, -white], dim=-1) - drift, nan=0.0), dim=-2)
    lowest = torch.cummin(sums, dim=-2).values.clamp(max=0.0)
    return (sums - lowest).amax(dim=-1)


def cusum_on(white: Tensor, drift: float, before: Tensor | None) -> tuple[Tensor, Tensor]:
    """`cusum` of the next samples (S, C); before (2, 2 C): the sums and their minima after the last one."""
    moves = torch.nan_to_num(torch.cat([white, -white], dim=-1) - drift, nan=0.0)
    before = torch.zeros(2, moves.shape[-1], dtype=moves.dtype) if before is None else before
    sums = torch.cumsum(torch.cat([before[:1], moves]), dim=0)
    lowest = torch.cummin(torch.cat([before[1:], sums[1:]]), dim=0).values
    return (sums - lowest)[1:].amax(dim=-1), torch.stack([sums[-1], lowest[-1]])


def glr_on(white: Tensor, lengths: tuple[int, ...], before: Tensor | None) -> tuple[Tensor, Tensor]:
    """`glr` of the next samples (S, C); before (N, C): the last N cumulative sums, N the longest window at most."""
    fresh = torch.nan_to_num(white, nan=0.0)
    before = torch.zeros(1, fresh.shape[-1], dtype=fresh.dtype) if before is None else before
    sums = torch.cat([before[:-1], torch.cumsum(torch.cat([before[-1:], fresh]), dim=0)])
    best, count = torch.zeros_like(fresh[:, 0]), len(fresh)
    for n in lengths:
        reach = min(count, len(sums) - n)
        if reach <= 0:
            break
        last = sums[len(sums) - reach :]
        best[-reach:] = torch.maximum(best[-reach:], (last - sums[-reach - n : len(sums) - n]).square().sum(-1) / n)
    return best, sums[-(lengths[-1] + 1) :]


def glr(white: Tensor, lengths: tuple[int, ...]) -> Tensor:
    """The largest over windows of the last n samples of |sum e|^2 / n: twice the log likelihood ratio of a changed mean
    in any channels (Willsky & Jones 1976), n from `lengths`.
    """
    sums = torch.cumsum(torch.nan_to_num(white, nan=0.0), dim=-2)
    best = torch.zeros_like(sums[..., 0])
    for n in lengths:
        if n > sums.shape[-2]:
            break
        shifted = torch.cat([torch.zeros_like(sums[..., :n, :]), sums[..., :-n, :]], dim=-2)
        best = torch.maximum(best, (sums - shifted).square().sum(dim=-1) / n)
    return best


def window_lengths(longest: int) -> tuple[int, ...]:
    """1, 2, 3, 4, 6, 8, 11, 16, ... up to `longest`: half an octave apart, which loses 1.5 % of a shift's evidence."""
    if longest < 1:
        raise ValueError(f"expected a GLR window of at least one sample, got {longest}")
    lengths = {min(round(2.0 ** (i / 2)), longest) for i in range(2 * math.ceil(math.log2(max(longest, 2))) + 1)}
    return tuple(sorted(lengths))
