"""Noise of readings without a model of the plant."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float

MEDIAN = 0.6745
"""Median of |x| for a standard normal x."""


def sample_noise(
    values: Float[torch.Tensor, "S C"], weight: Float[torch.Tensor, "S C"] | None = None
) -> Float[torch.Tensor, " C"]:
    """Model-free estimate of the readings' noise (C,) from second differences of neighbouring samples (S, C).

    sigma = median |y_{s+1} - 2 y_s + y_{s-1}| / (MEDIAN sqrt 6). Second differences remove a smooth signal, and the
    median is robust against a few switching events (Hall, Kay & Titterington 1990). weight (S, C): 0 masks a
    reading; by default all count.
    """
    weight = torch.ones_like(values) if weight is None else weight
    valid = (weight[2:] > 0) & (weight[1:-1] > 0) & (weight[:-2] > 0)
    second = (values[2:] - 2.0 * values[1:-1] + values[:-2]).abs() / math.sqrt(6.0)
    levels = [
        second[:, c][valid[:, c]].median() / MEDIAN if bool(valid[:, c].any()) else second.new_zeros(())
        for c in range(values.shape[1])
    ]
    return torch.stack(levels)
