"""Refinement with gradients alone: Adam (Kingma & Ba 2015), batched, kept in its box by projection.

Steps are measured in each parameter's `typical_size`, so that units do not matter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.refined import (
    CONVERGED,
    FAILED,
    MAX_ITERATIONS,
    Refined,
    finite,
    flat_box,
    held_back,
    typical_size,
)

_MEAN, _SQUARE = 0.9, 0.999


@dataclass(frozen=True)
class AdamSettings:
    """learning_rate: the first step as a share of a parameter's typical size; falls to zero along a cosine.

    gradient_tolerance: what a member must reach to count as converged, as a share of its gradient at the start.
    """

    iterations: int = 500
    learning_rate: float = 0.05
    gradient_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        if self.iterations < 1 or not self.learning_rate > 0 or not self.gradient_tolerance > 0:
            raise ValueError(f"expected iterations >= 1, positive rate and tolerance, got {self}; change them")


@dataclass(frozen=True)
class _Point:
    theta: Tensor  # (B, P)
    cost: Tensor  # (B,)
    gradient: Tensor  # (B, P)

    def where(self, first: Tensor, other: _Point) -> _Point:
        """This where `first` (B,), the other elsewhere."""
        return _Point(
            torch.where(first[:, None], self.theta, other.theta),
            torch.where(first, self.cost, other.cost),
            torch.where(first[:, None], self.gradient, other.gradient),
        )


def adam(
    value_and_gradient: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    start: Tensor,
    low: Tensor,
    high: Tensor,
    settings: AdamSettings | None = None,
    on_iteration: Callable[[int, Tensor, Tensor, Tensor], None] | None = None,
) -> Refined:
    """Minimises the cost of every member from `start` (*batch, P) within [low, high]; returns the best point it saw.

    `value_and_gradient(theta (B, P), lanes (B,))` -> cost (B,), gradient (B, P). A member that meets a cost or gradient
    that is not finite goes back to its best point with half the rate. `on_iteration`: iteration, lanes, theta and cost.
    """
    settings = settings or AdamSettings()
    theta, low, high = flat_box(start, low, high)
    lanes = torch.arange(len(theta), device=theta.device)
    size = typical_size(theta, low, high)
    size = torch.where(size > 0, size, 1.0)
    point = first = best = _Point(theta, *value_and_gradient(theta, lanes))
    mean, square = torch.zeros_like(theta), torch.zeros_like(theta)
    rate = torch.full_like(first.cost, settings.learning_rate)
    for k in range(1, settings.iterations + 1):
        fine = finite(point.cost, point.gradient)
        point, rate = point.where(fine, best), torch.where(fine, rate, 0.5 * rate)
        slope = point.gradient * size
        mean, square = _MEAN * mean + (1 - _MEAN) * slope, _SQUARE * square + (1 - _SQUARE) * slope * slope
        step = mean / (1 - _MEAN**k) / ((square / (1 - _SQUARE**k)).sqrt() + torch.finfo(theta.dtype).tiny)
        fall = 0.5 * (1.0 + math.cos(math.pi * k / settings.iterations))
        theta = (point.theta - fall * rate[:, None] * step * size).clamp(low, high)
        point = _Point(theta, *value_and_gradient(theta, lanes))
        best = point.where(finite(point.cost, point.gradient) & (point.cost < best.cost), best)
        if on_iteration is not None:
            on_iteration(k, lanes, best.theta, best.cost)
    return _result(first, best, low, high, size, settings).unflatten(start.shape[:-1])


def _result(first: _Point, best: _Point, low: Tensor, high: Tensor, size: Tensor, settings: AdamSettings) -> Refined:
    held = held_back(best.theta, best.gradient, low, high)
    left = torch.where(held, 0.0, best.gradient * size).abs().amax(-1)
    flat = left <= settings.gradient_tolerance * (first.gradient * size).abs().amax(-1)
    iterations = torch.full(first.cost.shape, settings.iterations, device=held.device)
    status = torch.where(flat, CONVERGED, torch.full_like(iterations, MAX_ITERATIONS))
    return Refined(
        theta=best.theta,
        cost=best.cost,
        gradient=best.gradient,
        curvature=None,
        promised=torch.full_like(best.cost, math.nan),
        held=held,
        status=torch.where(finite(first.cost, first.gradient), status, FAILED),
        iterations=iterations,
    )
