"""Predictive distribution of a detector's false-alarm rate, and the threshold at which its mean is the rate asked for.

Noise learnt from a finite recording leaves the standard deviation of the white residual uncertain. The variance of a
channel over the learnt one has the posterior nu / chi-square(nu) of a normal variance. Its degrees of freedom
nu = 1 / (2 s^2) follow from the standard error s of ln of the standard deviation (Satterthwaite 1946), in which
autocorrelation and random flows are included.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from scipy.special import gammaincinv
from torch import Tensor

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

    chart_rate: of the chart. error: standard error (C,) of ln of the standard deviation of those sums of the residual
    that decide about an alarm at a threshold. share (D, C): probabilities at which the posterior is drawn. run_length:
    expected number of samples to a false alarm. interval: between samples, s.
    """

    chart_rate: ChartRate
    error: Callable[[float], Tensor]
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
        half_freedom = 0.25 / self.error(threshold).clamp(min=SMALLEST_ERROR).square()
        return (half_freedom / torch.from_numpy(gammaincinv(half_freedom.numpy(), self.share.numpy()))).sqrt()

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
        return replace(self, error=lambda threshold: self.error(threshold) * factor**-0.5)

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
