"""Objectives: the paper's sum of correlations and the Gaussian likelihood, of one or several recordings.

Both are taken from the engines' sums over samples, so no trajectory is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from fdi_torch.estimate.levenberg_marquardt import Linearisation
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.engine import Engine, Readings

Objective = Literal["correlation", "likelihood"]
OBJECTIVES: tuple[Objective, ...] = ("correlation", "likelihood")

# Residuals below this share of a channel's own spread are rounding, not noise.
ROUNDING_SHARE = 1e-9


@dataclass(frozen=True)
class Term:
    """One recording: the engine under its inputs, what was read, which columns of theta the engine takes, and the
    noise's standard deviation where it is known."""

    engine: Engine
    data: Readings
    columns: Tensor | None = None
    noise_std: Tensor | None = None

    def theta(self, theta: Tensor) -> Tensor:
        return theta if self.columns is None else theta[..., self.columns]


class Problem:
    """The cost of parameter vectors, in the two forms that search and refinement ask for.

    objective 'correlation': sum over channels of 1 - rho, which is (13), (18) of the 2020 paper as a minimum.
    objective 'likelihood': the negative log-likelihood of Gaussian noise. A term's noise_std (C,) or (problems, C), in
    the readings' units: where it is not given, each channel's noise level is unknown and is profiled out.
    Finite standard deviations of the space are Gaussian priors about its nominal values.
    """

    def __init__(
        self,
        space: ParameterSpace,
        terms: Sequence[Term],
        objective: Objective = "likelihood",
    ) -> None:
        if objective not in OBJECTIVES:
            raise ValueError(f"expected an objective of {', '.join(OBJECTIVES)}, got '{objective}'")
        if not terms:
            raise ValueError("expected at least one recording, got none")
        self.space, self.terms, self.objective = space, tuple(terms), objective
        if objective == "correlation":
            for term in self.terms:
                _expect_variation(term.data)

    def at_noise(self, levels: Sequence[Tensor]) -> Problem:
        """The likelihood of the same recordings at known noise levels, one (C,) for each."""
        known = [replace(term, noise_std=level) for term, level in zip(self.terms, levels, strict=True)]
        return Problem(self.space, known, "likelihood")

    def cost(self, theta: Tensor, lanes: Tensor) -> Tensor:
        """theta (L, N, P) of the problems `lanes` (L,) -> cost (L, N)."""
        total = self._prior(theta)
        for term in self.terms:
            data = of_lanes(term.data, lanes)
            sums = term.engine.moments(term.theta(theta), data)
            if self.objective == "correlation":
                total = total + correlation_loss(sums, data).sum(-1)
            else:
                total = total + deviance(sums[..., 1], data, known_noise(term, lanes)).sum(-1)
        return total

    def correlations(self, theta: Tensor, lanes: Tensor) -> Tensor:
        """rho of each channel of the first recording (18), (L, N, C)."""
        data = of_lanes(self.terms[0].data, lanes)
        return 1.0 - correlation_loss(self.terms[0].engine.moments(self.terms[0].theta(theta), data), data)

    def linearise(self, theta: Tensor, lanes: Tensor) -> Linearisation:
        """theta (L, P) -> cost (L), gradient (L, P) and Gauss-Newton curvature (L, P, P), priors included."""
        precision = self._precision(theta)
        away = torch.where(precision > 0, theta - self.space.nominal(theta), torch.zeros_like(theta))
        cost = self._prior(theta)
        gradient = precision * away
        curvature = torch.diag_embed(precision.expand_as(theta))
        for term in self.terms:
            data = of_lanes(term.data, lanes)
            own = term.theta(theta)
            gram = term.engine.gram(own.unsqueeze(1), data).squeeze(1)
            if self.objective == "correlation":
                parts = correlation_expansion(gram, data)
            else:
                parts = likelihood_expansion(gram, data, known_noise(term, lanes))
            cost = cost + parts.cost
            columns = torch.arange(own.shape[-1], device=theta.device) if term.columns is None else term.columns
            gradient = gradient.index_add(1, columns, parts.gradient)
            rows = curvature.new_zeros(len(theta), theta.shape[-1], own.shape[-1])
            rows = rows.index_add(1, columns, parts.curvature)
            curvature = curvature.index_add(2, columns, rows)
        return Linearisation(cost, gradient, curvature)

    def noise(self, theta: Tensor, lanes: Tensor) -> list[Tensor]:
        """For each recording the standard deviation of the residuals, corrected for the parameters spent, (L, C)."""
        levels = []
        for term in self.terms:
            data = of_lanes(term.data, lanes)
            squares = term.engine.moments(term.theta(theta.unsqueeze(1)), data)[:, 0, :, 1]
            spent = theta.shape[-1] / squares.shape[-1] / len(self.terms)
            levels.append(torch.sqrt(squares / (data.weight.sum(-2) - spent).clamp(min=1.0)))
        return levels

    def _precision(self, theta: Tensor) -> Tensor:
        return self.space.std(theta) ** -2

    def _prior(self, theta: Tensor) -> Tensor:
        precision = self._precision(theta)
        away = torch.where(precision > 0, theta - self.space.nominal(theta), torch.zeros_like(theta))
        return 0.5 * (precision * away * away).sum(-1)


def of_lanes(data: Readings, lanes: Tensor) -> Readings:
    """The readings of the problems `lanes` (L,); readings shared by all are passed on as they are."""
    if data.values.dim() == 2:
        return data
    return Readings(data.values[lanes], data.weight[lanes], None if data.ar is None else data.ar[lanes])


def spread_of(data: Readings) -> Tensor:
    """Weighted sum of squares of each channel about its mean, (C,) or (L, C)."""
    return (data.weight * (data.known - data.centre.unsqueeze(-2)) ** 2).sum(-2)


def known_noise(term: Term, lanes: Tensor) -> Tensor | None:
    """The noise levels of some problems, (C,) or (L, C); None where they are unknown."""
    std = term.noise_std
    return std if std is None or std.dim() == 1 else std[lanes]


def deviance(squares: Tensor, data: Readings, noise_std: Tensor | None) -> Tensor:
    """Each channel's negative log-likelihood, (L, N, C), from its sum of squares; constants dropped."""
    if noise_std is not None:
        return 0.5 * squares / _per_lane(noise_std, squares) ** 2
    count = _per_lane(data.weight.sum(-2), squares)
    return 0.5 * count * torch.log(squares / count.clamp(min=1.0) + _per_lane(_floor(data), squares))


def likelihood_expansion(gram: Tensor, data: Readings, noise_std: Tensor | None) -> Linearisation:
    """Gauss-Newton expansion of the negative log-likelihood, from the sums of products (L, C, P+3, P+3)."""
    squares = gram[..., -3, -3]
    cost = deviance(squares.unsqueeze(1), data, noise_std).squeeze(1).sum(-1)
    unknown = squares / data.weight.sum(-2).clamp(min=1.0) + _floor(data)
    variance = unknown if noise_std is None else (noise_std**2).expand_as(squares)
    scaled = gram / variance[..., None, None]
    return Linearisation(cost, -scaled[..., :-3, -3].sum(1), scaled[..., :-3, :-3].sum(1))


def correlation_loss(sums: Tensor, data: Readings) -> Tensor:
    """1 - rho of each channel (2020 paper, eq. 18) from sums of r, r^2, r y': (L, N, C, 3) -> (L, N, C).

    Through 1 - rho^2 = (Syy Srr' - Sry^2) / (Syy Sff), which keeps its digits as rho nears 1. A prediction that does
    not vary is uncorrelated: 1.
    """
    r, rr, ry = sums.unbind(-1)
    yy = _per_lane(spread_of(data), r)
    spread = rr - r * r / _per_lane(data.weight.sum(-2), r)
    ff = yy - 2.0 * ry + spread
    varies = ff > 1e-24 * yy
    safe = torch.where(varies, ff, torch.ones_like(ff))
    rho = (yy - ry) / torch.sqrt(yy * safe)
    near_one = (yy * spread - ry * ry) / (yy * safe) / (1.0 + rho.clamp(min=0.0))
    loss = torch.where(rho > 0, near_one, 1.0 - rho)
    return torch.where(varies | ~torch.isfinite(ff), loss, torch.ones_like(loss))


def correlation_expansion(gram: Tensor, data: Readings) -> Linearisation:
    """Gauss-Newton expansion of the sum of 1 - rho = |z - f|^2 / 2; z, f: readings and predictions at unit norm.

    gram (L, C, P+3, P+3): sums of products, see `Engine.gram`.
    """
    count = data.weight.sum(-2).expand(gram.shape[:-2])
    centred = gram - gram[..., :, -1:] * gram[..., -1:, :] / count[..., None, None]
    jj, jr, jy = centred[..., :-3, :-3], centred[..., :-3, -3], centred[..., :-3, -2]
    rr, ry, yy = centred[..., -3, -3], centred[..., -3, -2], centred[..., -2, -2]
    ff = yy - 2.0 * ry + rr
    jf = jy - jr
    fy = yy - ry
    gradient = -(jy - jf * (fy / ff)[..., None]) / torch.sqrt(yy * ff)[..., None]
    curvature = (jj - jf[..., :, None] * jf[..., None, :] / ff[..., None, None]) / ff[..., None, None]
    sums = torch.stack([gram[..., -3, -1], gram[..., -3, -3], gram[..., -3, -2]], dim=-1).unsqueeze(1)
    loss = correlation_loss(sums, data).squeeze(1)
    return Linearisation(loss.sum(1), gradient.sum(1), curvature.sum(1))


def _per_lane(per_channel: Tensor, like: Tensor) -> Tensor:
    """(C,) or (L, C) beside (L, N, C)."""
    return per_channel if per_channel.dim() == 1 else per_channel.unsqueeze(1) if like.dim() == 3 else per_channel


def _floor(data: Readings) -> Tensor:
    spread = spread_of(data) / data.weight.sum(-2).clamp(min=1.0)
    return spread * ROUNDING_SHARE**2 + 1e-300


def _expect_variation(data: Readings) -> None:
    spread = spread_of(data)
    if not bool((spread > 0).all()):
        channel = int((spread <= 0).nonzero()[0, -1])
        raise ValueError(
            f"expected channels that vary, got a constant one (number {channel + 1}), whose correlation is undefined; "
            "use the objective 'likelihood' or leave the channel out"
        )
