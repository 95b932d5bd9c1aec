"""Stuck sensors: readings that repeat for longer than noise and quantization allow.

Noise of standard deviation s, quantized in steps of q, repeats a number with a probability of at most

    p = P(|e| < q / 2) = erf(q / (2 sqrt(2) s)),

reached for a level in the middle of a step. Some run of L equal readings among n therefore has a probability of at most
n p^(L - 1). A sensor is stuck where that bound is below BY_CHANCE.

The quantization error is white and uniform only while q < 2 s (Widrow and Kollar, 2008, ch. 4). If the readings scatter
by less than a step, s cannot be estimated; p = 1 is used then, and no sensor counts as stuck.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from fdi_torch.sample_noise import sample_noise

BY_CHANCE = 1e-3
"""Probability of a false detection in a recording of a sound sensor."""


@dataclass(frozen=True)
class Scatter:
    """A sensor's noise: standard deviation without quantization; and step: smallest difference of two values."""

    noise: float
    step: float

    @property
    def repeat_probability(self) -> float:
        """Upper bound of the probability that a reading repeats the last one."""
        return math.erf(self.step / (2.0 * math.sqrt(2.0) * self.noise)) if self.noise > 0.0 else 1.0


def resolution(values: torch.Tensor) -> float:
    """The smallest difference of two distinct values (n,), apart from rounding in the file; 0 for fewer than two."""
    steps = torch.diff(values.unique())
    steps = steps[steps > 1e-9 * float(values.abs().max())] if len(steps) else steps
    return float(steps.min()) if len(steps) else 0.0


def scatter(values: torch.Tensor) -> Scatter:
    """Noise and quantization step of changing readings (n,).

    Second differences of white noise quantized in steps q have the variance 6 (s^2 + q^2 / 12); those of the level are
    small. noise is 0 if the readings scatter by less than a step.
    """
    step = resolution(values)
    if len(values) < 3 or step == 0.0:
        return Scatter(0.0, step)
    total = float(sample_noise(values[:, None]))
    return Scatter(math.sqrt(total**2 - step**2 / 12.0) if total > step else 0.0, step)


def stuck_runs(values: torch.Tensor, usual: Scatter | None = None) -> list[tuple[int, int]]:
    """Runs of equal readings among values (n,) that are too long for the sensor's noise: the first sample of each run,
    and the first sample after it.

    usual: noise and quantization step of such readings, needed for a sensor that never changes; by default estimated
    from the other readings.
    """
    count = len(values)
    if count < 3:
        return []
    _, lengths = torch.unique_consecutive(values, return_counts=True)
    ends = torch.cumsum(lengths, 0)
    starts = ends - lengths
    is_stuck = torch.zeros_like(lengths, dtype=torch.bool)
    while not bool(is_stuck.all()):
        longest = torch.where(is_stuck, 0, lengths).argmax()
        sound = torch.repeat_interleave(~is_stuck, lengths)
        sound[starts[longest] : ends[longest]] = False  # a stuck run says nothing about a sound sensor
        newly_stuck = ~is_stuck & (lengths > _longest(values, sound, usual))
        if not bool(newly_stuck.any()):
            break
        is_stuck = is_stuck | newly_stuck
    return list(zip(starts[is_stuck].tolist(), ends[is_stuck].tolist(), strict=True))


def _longest(values: torch.Tensor, sound: torch.Tensor, usual: Scatter | None) -> float:
    """The longest run that chance explains, from the sound readings or the usual scatter."""
    if usual is not None:
        repeat_probability = usual.repeat_probability
    else:
        pairs = sound[1:] & sound[:-1]
        repeats = int((torch.diff(values) == 0.0)[pairs].sum())
        repeat_probability = max(
            scatter(values[sound]).repeat_probability, (repeats + 1.0) / (int(pairs.sum()) + 2.0)
        )  # Laplace's rule
    if repeat_probability >= 1.0:
        return math.inf
    return max(2.0, 1.0 + math.log(BY_CHANCE / len(values)) / math.log(max(repeat_probability, 1e-12)))
