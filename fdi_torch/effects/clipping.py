"""What sensors that end at a limit have in common: where the rig clips readings, noise is clipped with the level."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.effect import Values

LOGISTIC = math.sqrt(3.0) / math.pi  # scale of a logistic noise over its standard deviation
LEAST = 1e-12


def noise_parameters(unit: str) -> tuple[Parameter, Parameter]:
    """What is clipped with the level, and where it enters."""
    return (
        Parameter("noise", unit, 0.0, 0.0, meaning="standard deviation of the noise that is clipped with the level"),
        Parameter("behind", "1", 0.0, 0.0, 1.0, meaning="share of it that comes behind the limit and meets it again"),
    )


def lost_to_noise(beyond: Tensor, p: Values) -> Tensor:
    """By how much the mean of a clipped noisy reading lies inside of the clipped level, in the reading's unit.

    E[max(x + e, 0)] - max(x, 0) = s log(1 + exp(-|x|/s)) for a logistic e of scale s, in closed form; for a normal one
    of the same deviation it is less than 2 % of that deviation away. Where a transmitter's range clips the level, and
    the logger's what the line adds, it stays beyond the limit what it is there. beyond: x, from the limit outwards.
    """
    scale = LOGISTIC * p["noise"]
    least = torch.clamp(scale, min=LEAST)
    before = torch.log(1.0 + torch.exp(-torch.abs(beyond) / least))
    behind = torch.log(1.0 + torch.exp(torch.clamp(beyond, max=0.0) / least))
    return scale * (before + p["behind"] * (behind - before))
