"""Detectors on white residuals, fixed threshold and CUSUM: the threshold at which the mean rate of false alarms, over
its predictive distribution, is the rate asked for.

Noise learnt from a finite recording leaves the standard deviation of the white residual uncertain. The variance of a
channel over the learnt one has the posterior nu / chi-square(nu) of a normal variance. Its degrees of freedom
nu = 1 / (2 s^2) follow from the standard error s of ln of the standard deviation (Satterthwaite 1946), in which
autocorrelation is included. Uncertain random flows multiply it by a log-normal factor: the posterior of the logarithms
of their intensities is normal (Laplace's approximation).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Literal

import torch
from scipy.special import gammaincinv
from torch import Tensor

from fdi_torch.monitor.whitening import Whitening

DRAWS = 1000  # from the posterior
# Twice the mean overshoot of a sum of standard normal numbers, -2 zeta(1/2) / sqrt(2 pi), and its decrease with the
# square of the drift, -zeta(-1/2) / (3 sqrt(2 pi)) (Chang & Peres 1997).
OVERSHOOT, DECREASE = 1.16519, 0.02765
SMALLEST_ERROR = 1e-6  # of a standard deviation that is known
SMALLEST_DRIFT = 1e-6  # over the standard deviation; below it the run length is that without a drift
RAREST = 1e-300  # rate that counts as different from zero, 1/s
VERY_LONG = 1e6  # learning, over that which was done, from which the rate's error falls with the square root of time
MOST_ALARMS = 10**9  # of a count

ChartRate = Callable[[float, Tensor], Tensor]
"""Alarms per sample (D,) at a threshold; standard deviations (D, C) of sums of the white residual over the learnt."""


@dataclass(frozen=True)
class FalseAlarmDesign:
    """Threshold and false-alarm rate of a chart.

    chart_rate: of the chart. length: of the sums of the residual that decide about an alarm at a threshold. errors:
    standard errors (C,) of ln of the standard deviation of sums of that length, by the number of samples and by the
    random flows. share (2, D, C): probabilities at which the posterior of each is drawn. run_length: expected number of
    samples to a false alarm. interval: between samples, s.
    """

    chart_rate: ChartRate
    length: Callable[[float], int]
    errors: Callable[[int], tuple[Tensor, Tensor]]
    share: Tensor
    run_length: float
    interval: float

    @cached_property
    def threshold(self) -> float:
        """The threshold at which the mean rate over all draws is one alarm in `run_length` samples, by bisection."""
        low, high = 0.0, 1.0
        while self._alarms(high) > 1.0:
            low, high = high, 2.0 * high
        while high - low > 1e-6 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._alarms(middle) > 1.0 else (low, middle)
        return high

    def _alarms(self, threshold: float) -> float:
        """Expected number of alarms in `run_length` samples."""
        return float(self.chart_rate(threshold, self.std(threshold)).mean()) * self.run_length

    def std(self, threshold: float) -> Tensor:
        """Draws (D, C) of the standard deviation of sums over the learnt one: quantiles of its posterior."""
        return self._std_of_sums(self.length(threshold))

    @cached_property
    def _std_of_sums(self) -> Callable[[int], Tensor]:
        """Draws by the length of the sums; kept, because the steps of a bisection share few lengths."""

        @cache
        def std(length: int) -> Tensor:
            by_samples, by_flows = self.errors(length)
            half_freedom = 0.25 / by_samples.clamp(min=SMALLEST_ERROR).square()
            chi_square = torch.from_numpy(gammaincinv(half_freedom.numpy(), self.share[0].numpy()))
            return (half_freedom / chi_square).sqrt() * torch.exp(by_flows * torch.special.ndtri(self.share[1]))

        return std

    @cached_property
    def rates(self) -> Tensor:
        """False alarms per second for each draw, (D,)."""
        return self.chart_rate(self.threshold, self.std(self.threshold)) / self.interval

    def quantile(self, probability: float) -> float:
        """Quantile of the rate, 1/s."""
        return max(float(torch.quantile(self.rates, probability)), RAREST)

    def count_quantile(self, seconds: float, probability: float) -> int:
        """Quantile of the number of false alarms in a time: a Poisson number under each draw."""
        expected = self.rates * seconds

        def share_up_to(count: int) -> float:
            return float(torch.special.gammaincc(torch.full_like(expected, count + 1.0), expected).mean())

        return bisect_left(range(MOST_ALARMS), probability, key=share_up_to)

    def longer(self, factor: float) -> FalseAlarmDesign:
        """The design after learning for `factor` times as long: standard errors fall with the square root of time."""

        def errors(length: int) -> tuple[Tensor, Tensor]:
            by_samples, by_flows = self.errors(length)
            return by_samples * factor**-0.5, by_flows * factor**-0.5

        return replace(self, errors=errors)

    def learning_factor(self, accuracy: float) -> float:
        """How many times as long the noise must be learnt to know the rate within a factor of `accuracy` (95 %)."""
        factor = VERY_LONG
        for _ in range(8):
            design = self.longer(factor)
            low, high = (math.log(design.quantile(p)) for p in (0.025, 0.975))
            factor *= (0.5 * (high - low) / math.log(accuracy)) ** 2
        return factor


def latin_hypercube(channels: int, generator: torch.Generator) -> Tensor:
    """Probabilities (DRAWS, C), each channel's evenly spaced and in random order."""
    order = torch.rand(DRAWS, channels, generator=generator).argsort(dim=0)
    return (order.to(torch.float64) + 0.5) / DRAWS


def fixed_rate(threshold: float, std: Tensor) -> Tensor:
    """Probability that max |e| exceeds the threshold h: 1 - prod (1 - 2 Q(h / std))."""
    return -torch.expm1(torch.log1p(-2.0 * torch.special.ndtr(-threshold / std)).sum(dim=-1))


def cusum_rate(threshold: float, std: Tensor, drift: float) -> Tensor:
    """Alarms per sample of 2 C one-sided sums g <- max(0, g +- e - drift); their rates add.

    The mean run length of each is (exp(2 k b) - 2 k b - 1) / (2 k^2) with k = drift / std and b = threshold / std +
    OVERSHOOT - DECREASE k^2 (Siegmund 1985), within 0.1 % for k up to 0.75 and run lengths above 20.
    """
    k = (drift / std).clamp(min=SMALLEST_DRIFT)
    twice = 2.0 * k * (threshold / std + OVERSHOOT - DECREASE * k.square())
    return (4.0 * k.square() / (torch.expm1(twice) - twice)).sum(dim=-1)


Chart = Literal["fixed", "cusum"]
CHARTS: tuple[Chart, ...] = ("fixed", "cusum")

# CUSUM's drift: half the shift, in standard deviations of the white residual, for which the detection delay is least.
DRIFT = 0.5


@dataclass(frozen=True)
class Detector:
    """A statistic of white residuals, and its threshold.

    design: of the threshold. update: (samples (*batch, S, C), memory or None at the start) -> (statistic (*batch, S),
    memory). Its result is identical to the last bit for any division of the samples into calls.
    """

    chart: str
    design: FalseAlarmDesign
    update: Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]

    @property
    def threshold(self) -> float:
        return self.design.threshold

    def shares(self, white: Tensor) -> Tensor:
        """Share (C,) of each channel in the statistic at the last sample of white residuals (S, C)."""
        single = torch.eye(white.shape[-1], dtype=torch.bool).unsqueeze(1)
        each = self.update(torch.where(single, white, 0.0), None)[0][:, -1]
        return each / each.sum().clamp(min=1e-300)

    def alarms(self, white: Tensor) -> Tensor:
        """(*batch, S), True where an alarm is raised. After each, the detector restarts with the next sample."""
        remaining = torch.nan_to_num(white, nan=0.0)
        index = torch.arange(remaining.shape[-2], device=remaining.device)
        alarms = torch.zeros(remaining.shape[:-1], dtype=torch.bool, device=remaining.device)
        while bool((above := self.update(remaining, None)[0] > self.threshold).any()):
            first = torch.where(above.any(dim=-1), above.to(torch.int8).argmax(dim=-1), -1).unsqueeze(-1)
            alarms = alarms | (index == first)
            remaining = torch.where((index <= first).unsqueeze(-1), torch.zeros_like(remaining), remaining)
        return alarms


def make_detector(
    chart: Chart,
    time_between_false_alarms: float,
    sampling: float,
    channels: int,
    generator: torch.Generator,
    learnt: Whitening | None = None,
) -> Detector:
    """A detector with the given mean time between false alarms (s) over all channels together.

    sampling: s between samples. learnt: whitening estimated from a finite recording, whose uncertainty raises the
    threshold; without it the noise is known. Raises ValueError.
    """
    run_length = time_between_false_alarms / sampling
    if not run_length >= 20.0:
        raise ValueError(
            f"expected a mean time between false alarms of at least 20 samples, got {run_length:g} samples; "
            "ask for fewer false alarms"
        )
    rate: ChartRate
    update: Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]
    length: Callable[[float], int]
    if chart == "fixed":
        rate, length, update = fixed_rate, lambda threshold: 1, max_abs
    elif chart == "cusum":
        # A sum that alarms by chance has most likely grown by the drift with each sample.
        rate, length = partial(cusum_rate, drift=DRIFT), lambda threshold: max(round(threshold / DRIFT), 1)
        update = partial(cusum, DRIFT)
    else:
        raise ValueError(f"expected a detector of {', '.join(CHARTS)}, got '{chart}'")

    none = torch.zeros(channels, dtype=torch.float64)

    @cache
    def errors(length: int) -> tuple[Tensor, Tensor]:
        return (none, none) if learnt is None else learnt.errors_of_sums(length)

    share = torch.full((2, 1, channels), 0.5, dtype=torch.float64)
    if learnt is not None:
        share = torch.stack([latin_hypercube(channels, generator) for _ in range(2)])
    return Detector(chart, FalseAlarmDesign(rate, length, errors, share, run_length, sampling), update)


def max_abs(white: Tensor, before: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """max over channels of |e|, for white (*batch, S, C). It has no memory."""
    return torch.nan_to_num(white, nan=0.0).abs().amax(dim=-1), white[..., :0, :]


def cusum(drift: float, white: Tensor, before: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The largest of 2 C one-sided sums g = max(0, g +- e - drift) (Page 1954), as a sum minus its running minimum.

    A missing reading leaves its sums unchanged; otherwise the drift would reset the sums of a rarely read sensor. white
    (*batch, S, C); before (*batch, 2, 2 C): the sums and their minima after the previous sample.
    """
    moves = torch.nan_to_num(torch.cat([white, -white], dim=-1) - drift, nan=0.0)
    before = moves.new_zeros(*moves.shape[:-2], 2, moves.shape[-1]) if before is None else before
    sums = torch.cumsum(torch.cat([before[..., :1, :], moves], dim=-2), dim=-2)[..., 1:, :]
    lowest = torch.cummin(torch.cat([before[..., 1:, :], sums], dim=-2), dim=-2).values[..., 1:, :]
    return (sums - lowest).amax(dim=-1), torch.stack([sums[..., -1, :], lowest[..., -1, :]], dim=-2)
