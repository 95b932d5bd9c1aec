"""A sensor whose reading is wrong by something slow that no form describes: noise of its own, of any size and pace.

Random flows move levels, and with them what other sensors read later; what only one reading holds is the sensor's. Its
size and correlation time are estimated with all other noise, and its evidence is the likelihood of the innovations
less what its two numbers cost: the size is believed to be anywhere between a tenth of the noise and the readings'
range, on a scale of logarithms, and as many values determine it as there are correlation times.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from fdi_torch.estimate.kalman import StateNoise, Wander
from fdi_torch.estimate.state_noise import CORRELATION_TIMES
from fdi_torch.gap.disturbances import most_likely
from fdi_torch.gap.fitting import Fit, Fitter

SMALLEST = 0.1  # of the sensor's noise


def begun(fitter: Fitter, fit: Fit, quiet: StateNoise, channel: int) -> StateNoise:
    """Where the search begins: all that a fit leaves of a reading is the sensor's. quiet: hardly any random flows."""
    seen = fitter.subject.mask[:, channel]
    left = (fitter.subject.readings - fit.near.readings[0])[seen, channel]
    std = max(float(left.square().mean().sqrt()), float(fitter.noise.std[channel]))
    return replace(quiet, wander=Wander(channel, std, CORRELATION_TIMES[3] * _interval(fitter)))


def likeliest(fitter: Fitter, fit: Fit, start: StateNoise) -> StateNoise:
    return most_likely(fitter, fit, fit.near, start=start).noise


def cost(fitter: Fitter, wander: Wander) -> float:
    """Of the two numbers, nats."""
    seen = fitter.subject.mask[:, wander.channel]
    readings = fitter.subject.readings[seen, wander.channel]
    noise = float(fitter.noise.std[wander.channel])
    width = math.log(max(float(readings.max() - readings.min()), noise) / (SMALLEST * noise))
    values = max(int(seen.sum()) * _interval(fitter) / wander.correlation_time, 1.0)
    return math.log(len(CORRELATION_TIMES) - 1) + max(math.log(width * math.sqrt(values / math.pi)), 0.0)


def is_rounding(fitter: Fitter, wander: Wander) -> bool:
    """Whether it is no more than the error of rounding, which changes slowly with the level: half a step at most."""
    steps = fitter.noise.steps
    return bool(steps) and wander.std < 0.5 * steps[wander.channel]


def size(fitter: Fitter, wander: Wander) -> float:
    """Of what it does to the readings, root of the sum of squares in units of the sensor's noise."""
    count = float(fitter.subject.mask[:, wander.channel].sum())
    return math.sqrt(count) * wander.std / float(fitter.noise.std[wander.channel])


def _interval(fitter: Fitter) -> float:
    return float(torch.median(torch.diff(fitter.subject.recording.time)))
