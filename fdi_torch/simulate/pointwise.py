"""Derivatives of pointwise functions of many inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Row = Sequence[Tensor | None]


def partials(
    function: Callable[[list[Tensor]], Sequence[Tensor]], inputs: Sequence[Tensor], shape: Sequence[int]
) -> tuple[list[Tensor], list[Row]]:
    """y_i = function(x)_i and dy_i/dx_j, each of `shape`; None where y_i does not depend on x_j.

    inputs broadcast to `shape`. One backward pass per output: the cost does not grow with the number of inputs.
    """
    leaves = [x.detach().expand(shape).requires_grad_() for x in inputs]
    with torch.enable_grad():
        outputs = [y.expand(shape) for y in function(leaves)]
        # The sum's gradient holds all elementwise slopes, since no element depends on another element's inputs.
        totals = [y.sum() for y in outputs]
    rows: list[Row] = [
        torch.autograd.grad(total, leaves, retain_graph=True, allow_unused=True)
        if total.requires_grad and leaves
        else [None] * len(leaves)
        for total in totals
    ]
    return [y.detach() for y in outputs], rows
