"""Rules that return candidates outside their bounds to the box.

`low`, `high` broadcast against `theta` (*batch, P). Components inside the box are not changed.
"""

from __future__ import annotations

import torch
from torch import Tensor


def halfway(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Midpoint between the parent and the violated bound (Zhang & Sanderson 2009, JADE; Tanabe & Fukunaga 2014).

    parent: the vector inside the box that `theta` was made from.
    """
    return _where_outside(theta, (torch.where(theta < low, low, high) + parent) / 2.0, low, high)


def reflected(theta: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Reflection at the bounds, as often as needed."""
    width = high - low
    turns = torch.remainder((theta - low) / torch.where(width > 0, width, 1.0), 2.0)
    return _where_outside(theta, low + width * torch.where(turns > 1.0, 2.0 - turns, turns), low, high)


def _where_outside(theta: Tensor, repaired: Tensor, low: Tensor, high: Tensor) -> Tensor:
    # The clamp removes rounding errors: low + 1.0 * width may exceed high.
    return torch.where((theta < low) | (theta > high), repaired.clamp(low, high), theta)
