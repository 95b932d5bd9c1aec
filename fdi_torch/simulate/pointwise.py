"""Derivatives of pointwise functions of many inputs."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache

import torch
from torch import Tensor

Row = Sequence[Tensor | None]
Pointwise = Callable[[list[Tensor]], Sequence[Tensor]]


class Partials:
    """y_i = function(x)_i and dy_i/dx_j, each of `shape`; None where y_i does not depend on x_j.

    The first call needs one backward pass per output, and finds which inputs each depends on. In later calls, as long
    as the dependences are the same, outputs without a common input share a pass (Curtis, Powell and Reid, 1974): a
    network of any size needs about as many passes as a tank has neighbours.
    """

    def __init__(self) -> None:
        self._groups: list[list[int]] = []
        self._inputs: list[set[int]] = []

    def __call__(
        self, function: Pointwise, inputs: Sequence[Tensor], shape: Sequence[int]
    ) -> tuple[list[Tensor], list[Row]]:
        leaves = [x.detach().expand(shape).requires_grad_() for x in inputs]
        with torch.enable_grad():
            outputs = [y.expand(shape) for y in function(leaves)]
            # The sum's gradient holds all elementwise slopes, since no element depends on another element's inputs.
            totals = [y.sum() for y in outputs]
        rows = self._in_groups(totals, leaves)
        if rows is None:
            rows = [_slopes([total], leaves) for total in totals]
            self._inputs = [{j for j, slope in enumerate(row) if slope is not None} for row in rows]
            self._groups = _without_common_inputs(self._inputs)
        return [y.detach() for y in outputs], rows

    def _in_groups(self, totals: Sequence[Tensor], leaves: Sequence[Tensor]) -> list[Row] | None:
        """The rows by one pass for each group; None before the first call and where the dependences differ."""
        if not self._groups or len(totals) != len(self._inputs):
            return None
        rows: list[Row] = [[] for _ in totals]
        for group in self._groups:
            shared = _slopes([totals[i] for i in group], leaves)
            known = set().union(*(self._inputs[i] for i in group))
            if {j for j, slope in enumerate(shared) if slope is not None} != known:
                return None
            for i in group:
                rows[i] = [slope if j in self._inputs[i] else None for j, slope in enumerate(shared)]
        return rows


@lru_cache(maxsize=1024)
def partials_of(*function: Hashable) -> Partials:
    """The partials of a function that these values describe, so that each finds its dependences once."""
    return Partials()


def partials(function: Pointwise, inputs: Sequence[Tensor], shape: Sequence[int]) -> tuple[list[Tensor], list[Row]]:
    """The same for one call."""
    return Partials()(function, inputs, shape)


def _slopes(totals: Sequence[Tensor], leaves: Sequence[Tensor]) -> Row:
    """Gradient of a sum by each leaf."""
    differentiable = [total for total in totals if total.requires_grad]
    if not differentiable or not leaves:
        return [None] * len(leaves)
    return torch.autograd.grad(differentiable, leaves, retain_graph=True, allow_unused=True)


def _without_common_inputs(inputs: Sequence[set[int]]) -> list[list[int]]:
    """Groups of outputs, of which no two depend on the same input; greedily."""
    groups: list[list[int]] = []
    for i, own in enumerate(inputs):
        for group in groups:
            if all(own.isdisjoint(inputs[k]) for k in group):
                group.append(i)
                break
        else:
            groups.append([i])
    return groups
