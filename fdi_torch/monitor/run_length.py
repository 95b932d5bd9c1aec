"""Run lengths of control charts on white residuals of unit variance, and thresholds for a given mean run length."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

CHAIN_STATES = 400
RAREST = 1.0 / (CHAIN_STATES * torch.finfo(torch.float64).eps)
"""Run length of one chart above which rounding errors in the Markov chain are as large as the alarm rate."""
# Simulated blocks. The probability of an alarm in a block is fitted as a function of the threshold, which needs fewer
# draws than counting alarms.
BLOCKS, BLOCK, BURN_IN = 4000, 1500, 500


def fixed_threshold(run_length: float, channels: int) -> float:
    """h that max |e| of C white Gaussian channels exceeds once in N samples: 1 - (1 - 2 Q(h))^C = 1/N."""
    _expect_rare(run_length)
    one = -math.expm1(math.log1p(-1.0 / run_length) / channels)
    return -float(torch.special.ndtri(torch.tensor(0.5 * one, dtype=torch.float64)))


def cusum_run_length(threshold: float, drift: float, states: int = CHAIN_STATES) -> float:
    """Mean number of samples until g <- max(0, g + e - drift), from g = 0, exceeds the threshold; e standard normal.

    Brook & Evans (1972): g on a grid as a Markov chain. Infinite if an alarm is too rare for double precision.
    """
    width = threshold / (states - 0.5)
    centres = width * torch.arange(states, dtype=torch.float64)
    rise = centres[None, :] - centres[:, None] + drift
    upper = torch.special.ndtr(rise + 0.5 * width)
    lower = torch.special.ndtr(rise - 0.5 * width)
    lower[:, 0] = 0.0
    stay = upper - lower
    ones = torch.ones(states, dtype=torch.float64)
    lengths, singular = torch.linalg.solve_ex(torch.eye(states, dtype=torch.float64) - stay, ones)
    return math.inf if bool(singular) else float(lengths[0])


def cusum_threshold(run_length: float, channels: int, drift: float) -> float:
    """h of 2 C one-sided charts that together alarm once in `run_length` samples (their rates add)."""
    _expect_rare(run_length, 2 * channels)
    wanted = 2.0 * channels * run_length
    low, high = 1e-3, 1.0
    while cusum_run_length(high, drift) < wanted:
        high *= 2.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if cusum_run_length(middle, drift) < wanted else (low, middle)
    return 0.5 * (low + high)


def block_maxima(statistic: Callable[[Tensor], Tensor], channels: int, generator: torch.Generator) -> Tensor:
    """Sorted maxima of a statistic (*batch, S, C) -> (*batch, S) in simulated blocks of white residuals."""
    maxima = []
    for _ in range(BLOCKS // 200):
        noise = torch.randn(200, BURN_IN + BLOCK, channels, generator=generator, dtype=torch.float64)
        maxima.append(statistic(noise)[:, BURN_IN:].amax(dim=1))
    return torch.cat(maxima).sort().values


def threshold_from_maxima(peaks: Tensor, run_length: float) -> float:
    """h of any statistic, from its sorted maxima in blocks of white residuals.

    In the steady state the probability of an alarm within a block of B samples is 1 - exp(-B / N). log(-log P(no
    alarm)) is fitted by a parabola in h, so that all blocks contribute to the estimate of a rare alarm. Raises
    ValueError for N below 20 samples.
    """
    _expect_rare(run_length)
    share = (torch.arange(len(peaks), dtype=torch.float64) + 0.5) / len(peaks)
    used = (share > 0.02) & (share < 0.995)
    hazard = torch.log(-torch.log(share[used]))
    centre = peaks[used].mean()
    powers = torch.stack([(peaks[used] - centre) ** i for i in range(3)], dim=1)
    c0, c1, c2 = torch.linalg.lstsq(powers, hazard.unsqueeze(1)).solution.flatten().tolist()
    return float(centre) + _falling_root(c0 - math.log(BLOCK / run_length), c1, c2)


def _falling_root(c0: float, c1: float, c2: float) -> float:
    """The zero of c0 + c1 x + c2 x^2 at which it falls; the tangent's zero if there is none."""
    inside = c1 * c1 - 4.0 * c2 * c0
    if inside <= 0.0 or abs(c2) < 1e-12:
        return -c0 / c1
    return 2.0 * c0 / (-c1 + math.sqrt(inside))


def _expect_rare(run_length: float, charts: int = 1) -> None:
    if not run_length >= 20.0:
        raise ValueError(
            f"expected a mean time between false alarms of at least 20 samples, got {run_length:g} samples; "
            "ask for fewer false alarms"
        )
    if not charts * run_length < RAREST:
        raise ValueError(
            f"expected a mean time between false alarms below {RAREST / charts:.2g} samples, above which their rate is "
            f"lost in rounding, got {run_length:.3g} samples; ask for more false alarms"
        )
