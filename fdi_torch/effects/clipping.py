"""Clipping of noisy readings, for sensors with a lower or upper limit."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.effect import Values

LOGISTIC = math.sqrt(3.0) / math.pi  # scale of a logistic noise over its standard deviation
LEAST = 1e-12


def noise_parameters(unit: str) -> tuple[Parameter, Parameter]:
    """The standard deviation of the clipped noise, and the share of it that is added after the first limit."""
    return (
        Parameter("noise", unit, 0.0, 0.0, meaning="standard deviation of the noise that is clipped with the level"),
        Parameter("behind", "1", 0.0, 0.0, 1.0, meaning="share of the noise added after a first limit"),
    )


def clipping_bias(beyond: Tensor, p: Values) -> Tensor:
    """Distance of the mean of a clipped noisy reading from the clipped level, towards the inside, in the reading's
    unit.

    E[max(x + e, 0)] - max(x, 0) = s log(1 + exp(-|x|/s)) for logistic noise e of scale s; for normal noise of the same
    standard deviation the error is below 2 % of that. `p["behind"]` is the share of the noise that enters between two
    limits (transmitter, then logger); its contribution stays constant beyond the limit. beyond: x, positive outside.
    """
    scale = LOGISTIC * p["noise"]
    positive_scale = torch.clamp(scale, min=LEAST)
    one_limit = torch.log(1.0 + torch.exp(-torch.abs(beyond) / positive_scale))
    two_limits = torch.log(1.0 + torch.exp(torch.clamp(beyond, max=0.0) / positive_scale))
    return scale * (one_limit + p["behind"] * (two_limits - one_limit))
