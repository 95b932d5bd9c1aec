"""Derivatives of pointwise functions of many inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Row = Sequence[Tensor | None]
Pointwise = Callable[[list[Tensor]], Sequence[Tensor]]


def partials(function: Pointwise, inputs: Sequence[Tensor], shape: Sequence[int]) -> tuple[list[Tensor], list[Row]]:
    """y_i = function(x)_i and dy_i/dx_j, each of `shape`; None where y_i does not depend on x_j. One backward pass per
    output."""
    leaves = [x.detach().expand(shape).requires_grad_() for x in inputs]
    with torch.enable_grad():
        outputs = [y.expand(shape) for y in function(leaves)]
        # The sum's gradient holds all elementwise slopes, since no element depends on another element's inputs.
        totals = [y.sum() for y in outputs]
    return [y.detach() for y in outputs], [_slopes(total, leaves) for total in totals]


def _slopes(total: Tensor, leaves: Sequence[Tensor]) -> Row:
    """Gradient of a sum by each leaf."""
    if not total.requires_grad or not leaves:
        return [None] * len(leaves)
    return torch.autograd.grad(total, leaves, retain_graph=True, allow_unused=True)
