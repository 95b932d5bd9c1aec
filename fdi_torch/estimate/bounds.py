"""Rules that bring a vector back into its box; what is inside already keeps every bit.

`low`, `high` broadcast against `theta` (*batch, P). Every rule returns values within [low, high].
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Rule = Callable[[Tensor, Tensor, Tensor, Tensor, Callable[[], Tensor]], Tensor]


def _clip(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    return theta


def _reflect(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """Mirrored at the bounds, as often as needed."""
    width = high - low
    turns = torch.remainder((theta - low) / torch.where(width > 0, width, 1.0), 2.0)
    return low + width * torch.where(turns > 1.0, 2.0 - turns, turns)


def _midpoint(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """Half way from the parent to the bound overstepped (Zhang & Sanderson 2009, JADE; Tanabe & Fukunaga 2014)."""
    return (torch.where(theta < low, low, high) + parent) / 2.0


def _resample(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """Anew, uniformly in the box."""
    return low + draw().to(low.dtype) * (high - low)


RULES: dict[str, Rule] = {"clip": _clip, "reflect": _reflect, "midpoint": _midpoint, "resample": _resample}


def into_box(theta: Tensor, parent: Tensor, low: Tensor, high: Tensor, rule: str, draw: Callable[[], Tensor]) -> Tensor:
    """`theta` (*batch, P) with the components that left the box brought back by the named rule.

    parent: the vector inside the box that `theta` came from. draw: gives uniform draws shaped like `theta`, asked for
    by "resample" only.
    """
    outside = (theta < low) | (theta > high)
    repaired = RULES[rule](theta, parent, low, high, draw)
    # The clamp takes care of rounding (low + 1.0 * width may lie beyond high).
    return torch.where(outside, repaired.clamp(low, high), theta)
