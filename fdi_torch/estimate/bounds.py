"""Rules of differential evolution that return components outside their bounds to the box.

`low`, `high` broadcast against `theta` (*batch, P). Components inside the box are not changed.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Rule = Callable[[Tensor, Tensor, Tensor, Tensor, Callable[[], Tensor]], Tensor]


def _clip(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """Set to the bound; `into_box` clamps."""
    return theta


def _reflect(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """Reflect at the bounds, as often as needed."""
    width = high - low
    turns = torch.remainder((theta - low) / torch.where(width > 0, width, 1.0), 2.0)
    return low + width * torch.where(turns > 1.0, 2.0 - turns, turns)


def _midpoint(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """Midpoint between the parent and the violated bound (Zhang & Sanderson 2009, JADE; Tanabe & Fukunaga 2014)."""
    return (torch.where(theta < low, low, high) + parent) / 2.0


def _resample(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """Draw again, uniformly in the box."""
    return low + draw().to(low.dtype) * (high - low)


RULES: dict[str, Rule] = {"clip": _clip, "reflect": _reflect, "midpoint": _midpoint, "resample": _resample}


def into_box(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, rule: str, draw: Callable[[], Tensor]) -> Tensor:
    """Apply the named rule to the components of `theta` (*batch, P) that are outside the box.

    parent: the vector inside the box that `theta` was made from. draw: returns uniform random numbers on (0, 1) in the
    shape of `theta`; only "resample" calls it.
    """
    outside = (theta < low) | (theta > high)
    repaired = RULES[rule](theta, parent, low, high, draw)
    # The clamp removes rounding errors: low + 1.0 * width may exceed high.
    return torch.where(outside, repaired.clamp(low, high), theta)
