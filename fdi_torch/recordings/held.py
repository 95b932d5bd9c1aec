"""Readings that repeat the last one for longer than noise and rounding let them: a sensor that is stuck.

Noise of standard deviation s, read in steps of q, gives the same number twice in a row with a probability of at most

    p = P(|e| < q / 2) = erf(q / (2 sqrt(2) s)),

where the level rests in the middle of a step. So some run of L equal readings among n has one of at most n p^(L - 1).
Where they scatter by less than a step, rounding hides how much of that is noise (Widrow and Kollar, 2008, ch. 4: its
error is white and uniform while q < 2 s): then p is taken to be 1, and the readings by themselves tell nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

BY_CHANCE = 1e-3
"""Probability that a recording of a sound sensor has a run that is called too long."""
NORMAL_MEDIAN = 0.6745
"""Of the size of a standard normal number."""


@dataclass(frozen=True)
class Scatter:
    """Of a sensor's readings. noise: standard deviation without rounding. step: between two values that it can take."""

    noise: float
    step: float

    @property
    def same_again(self) -> float:
        """The most probable that a reading repeats the last one."""
        return math.erf(self.step / (2.0 * math.sqrt(2.0) * self.noise)) if self.noise > 0.0 else 1.0


def resolution(values: Tensor) -> float:
    """The smallest step between two different values, rounding of the file apart; 0 for a constant."""
    steps = torch.diff(values.unique())
    steps = steps[steps > 1e-9 * float(values.abs().max())]
    return float(steps.min()) if len(steps) else 0.0


def scatter(values: Tensor) -> Scatter:
    """Of readings (n,) that move: second differences of white noise, rounded to q, have a variance of
    6 (s^2 + q^2 / 12), and the level's own are small. noise: 0 where they scatter by less than a step.
    """
    step = resolution(values) if len(values) else 0.0
    if len(values) < 3 or step == 0.0:
        return Scatter(0.0, step)
    spread = float(torch.diff(values, n=2).abs().median()) / (NORMAL_MEDIAN * math.sqrt(6.0))
    return Scatter(math.sqrt(spread**2 - step**2 / 12.0) if spread > step else 0.0, step)


def held(values: Tensor, usual: Scatter | None = None) -> list[tuple[int, int]]:
    """Runs of equal readings among values (n,) that are too long: the first sample of each, and the first beyond.

    usual: the scatter of readings of this kind, for those that never move; by default what the rest of them shows.
    """
    count = len(values)
    if count < 3:
        return []
    _, lengths = torch.unique_consecutive(values, return_counts=True)
    ends = torch.cumsum(lengths, 0)
    starts = ends - lengths
    long = torch.zeros_like(lengths, dtype=torch.bool)
    while not bool(long.all()):
        longest = torch.where(long, 0, lengths).argmax()
        rest = torch.repeat_interleave(~long, lengths)
        rest[starts[longest] : ends[longest]] = False  # what is held tells nothing of how a sound sensor repeats itself
        found = ~long & (lengths > _longest(values, rest, usual))
        if not bool(found.any()):
            break
        long = long | found
    return list(zip(starts[long].tolist(), ends[long].tolist(), strict=True))


def _longest(values: Tensor, rest: Tensor, usual: Scatter | None) -> float:
    """The longest run that chance makes, by the readings that are not held or by what is usual."""
    if usual is not None:
        again = usual.same_again
    else:
        pairs = rest[1:] & rest[:-1]
        same = int((torch.diff(values) == 0.0)[pairs].sum())
        again = max(scatter(values[rest]).same_again, (same + 1.0) / (int(pairs.sum()) + 2.0))  # Laplace's rule
    if again >= 1.0:
        return math.inf
    return max(2.0, 1.0 + math.log(BY_CHANCE / len(values)) / math.log(max(again, 1e-12)))
