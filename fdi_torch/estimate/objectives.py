"""Objective functions: sum of correlations and Gaussian likelihood, for one or several recordings.

Both are computed from sums over samples that the simulation engine accumulates, so that no trajectory is stored.
L: problems ("lanes"), N: candidates of each, C: channels, P: parameters, S: samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fdi_torch.estimate.linearisation import Linearisation
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.engine import Engine, Readings

Objective = Literal["correlation", "likelihood"]
OBJECTIVES: tuple[Objective, ...] = ("correlation", "likelihood")

# Residuals below this fraction of a channel's standard deviation are rounding errors, not noise.
ROUNDING_SHARE = 1e-9


@dataclass(frozen=True)
class Term:
    """Contribution of one recording to the cost.

    engine: simulates the plant under the recording's inputs. data: readings and weights. columns: the columns of theta
    that the engine takes; None: all. noise_std (C,) or (problems, C): standard deviation of the noise, in the reading's
    unit; None if unknown.
    """

    engine: Engine
    data: Readings
    columns: Tensor | None = None
    noise_std: Tensor | None = None

    def theta(self, theta: Tensor) -> Tensor:
        return theta if self.columns is None else theta[..., self.columns]


class Problem:
    """Cost of parameter vectors: values for the search, a quadratic model for the refinement.

    objective 'correlation': sum over channels of 1 - rho, which turns (13), (18) of the 2020 paper into a minimisation.
    objective 'likelihood': negative log-likelihood of Gaussian noise. If a term has no noise_std, the noise level of
    each channel is unknown and profiled out.
    A finite standard deviation of a parameter in `space` is a Gaussian prior about its nominal value.
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
        """The likelihood of the same recordings with known noise levels, one tensor (C,) per recording."""
        terms = [replace(term, noise_std=level) for term, level in zip(self.terms, levels, strict=True)]
        return Problem(self.space, terms, "likelihood")

    def cost(self, theta: Float[Tensor, "L N P"], lanes: Int[Tensor, " L"]) -> Float[Tensor, "L N"]:
        """Cost (L, N) of the candidates theta (L, N, P) of the problems `lanes` (L,)."""
        total = self._prior(theta)[0]
        for term in self.terms:
            data = term.data.of(lanes)
            sums = term.engine.moments(term.theta(theta), data)
            if self.objective == "correlation":
                total = total + correlation_loss(sums, data).sum(-1)
            else:
                total = total + deviance(sums[..., 1], data, known_noise(term, lanes)).sum(-1)
        return total

    def correlations(self, theta: Float[Tensor, "L N P"], lanes: Int[Tensor, " L"]) -> Float[Tensor, "L N C"]:
        """Correlation rho (18) of each channel of the first recording, (L, N, C)."""
        data = self.terms[0].data.of(lanes)
        return 1.0 - correlation_loss(self.terms[0].engine.moments(self.terms[0].theta(theta), data), data)

    def linearise(self, theta: Float[Tensor, "L P"], lanes: Int[Tensor, " L"]) -> Linearisation:
        """Cost (L,), gradient (L, P) and Gauss-Newton curvature (L, P, P) at theta (L, P), priors included."""
        cost, gradient, precision = self._prior(theta)
        curvature = torch.diag_embed(precision.expand_as(theta))
        for term in self.terms:
            data = term.data.of(lanes)
            term_theta = term.theta(theta)
            gram = term.engine.gram(term_theta.unsqueeze(1), data).squeeze(1)
            if self.objective == "correlation":
                parts = correlation_expansion(gram, data)
            else:
                parts = likelihood_expansion(gram, data, known_noise(term, lanes))
            cost = cost + parts.cost
            columns = torch.arange(term_theta.shape[-1], device=theta.device) if term.columns is None else term.columns
            gradient = gradient.index_add(1, columns, parts.gradient)
            rows = curvature.new_zeros(len(theta), theta.shape[-1], term_theta.shape[-1])
            rows = rows.index_add(1, columns, parts.curvature)
            curvature = curvature.index_add(2, columns, rows)
        return Linearisation(cost, gradient, curvature)

    def noise(self, theta: Float[Tensor, "L P"], lanes: Int[Tensor, " L"]) -> list[Tensor]:
        """Standard deviation of one reading's residual, (L, C) for each recording.

        The P degrees of freedom that the parameters use are divided equally among all channels of all recordings.
        """
        levels = []
        for term in self.terms:
            data = term.data.of(lanes)
            squares = term.engine.moments(term.theta(theta.unsqueeze(1)), data)[:, 0, :, 1]
            lost_degrees = theta.shape[-1] / squares.shape[-1] / len(self.terms)
            levels.append(torch.sqrt(squares / (data.degrees - lost_degrees).clamp(min=1.0)))
        return levels

    def _prior(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (*batch) of the priors at theta (*batch, P), its gradient (*batch, P), and the precisions (P,)."""
        precision = self.space.std(theta) ** -2
        deviation = torch.where(precision > 0, theta - self.space.nominal(theta), torch.zeros_like(theta))
        gradient = precision * deviation
        return 0.5 * (gradient * deviation).sum(-1), gradient, precision


def spread_of(data: Readings) -> Float[Tensor, "*L C"]:
    """Weighted sum of squared deviations of each channel from its mean."""
    return (data.weight * (data.known - data.centre.unsqueeze(-2)) ** 2).sum(-2)


def known_noise(term: Term, lanes: Int[Tensor, " L"]) -> Float[Tensor, "*L C"] | None:
    """Noise levels of the problems `lanes`, common to all or one set each; None if unknown."""
    std = term.noise_std
    return std if std is None or std.dim() == 1 else std[lanes]


def deviance(
    squares: Float[Tensor, "L N C"], data: Readings, noise_std: Float[Tensor, "*L C"] | None
) -> Float[Tensor, "L N C"]:
    """Negative log-likelihood of each channel from its sum of squared residuals; constants are dropped.

    Known noise: SSR / (2 sigma^2). Unknown noise, profiled out: n/2 log(SSR / n), n being the number of values.
    """
    if noise_std is not None:
        return 0.5 * squares / _per_lane(noise_std, squares) ** 2
    count = _per_lane(data.degrees, squares)
    return 0.5 * count * torch.log(squares / count.clamp(min=1.0) + _per_lane(_rounding_variance(data), squares))


def likelihood_expansion(
    gram: Float[Tensor, "L C W W"], data: Readings, noise_std: Float[Tensor, "*L C"] | None
) -> Linearisation:
    """Gauss-Newton model of the negative log-likelihood, from the sums of products `Engine.gram`; W = P + 3."""
    squares = gram[..., -3, -3]
    cost = deviance(squares.unsqueeze(1), data, noise_std).squeeze(1).sum(-1)
    profiled = squares / data.degrees.clamp(min=1.0) + _rounding_variance(data)
    variance = profiled if noise_std is None else (noise_std**2).expand_as(squares)
    scaled = gram / variance[..., None, None]
    return Linearisation(cost, -scaled[..., :-3, -3].sum(1), scaled[..., :-3, :-3].sum(1))


def correlation_loss(sums: Float[Tensor, "L N C 3"], data: Readings) -> Float[Tensor, "L N C"]:
    """1 - rho of each channel (2020 paper, eq. 18) from the sums of r, r^2 and r y' (`Engine.moments`).

    Computed from 1 - rho^2 = (Syy Srr' - Sry^2) / (Syy Sff), which avoids cancellation as rho approaches 1. A constant
    prediction counts as uncorrelated, with a loss of 1.
    """
    r, rr, ry = sums.unbind(-1)
    yy = _per_lane(spread_of(data), r)
    residual_squares = rr - r * r / _per_lane(data.weight.sum(-2), r)
    ff = yy - 2.0 * ry + residual_squares
    varies = ff > 1e-24 * yy
    safe = torch.where(varies, ff, torch.ones_like(ff))
    rho = (yy - ry) / torch.sqrt(yy * safe)
    near_one = (yy * residual_squares - ry * ry) / (yy * safe) / (1.0 + rho.clamp(min=0.0))
    loss = torch.where(rho > 0, near_one, 1.0 - rho)
    return torch.where(varies | ~torch.isfinite(ff), loss, torch.ones_like(loss))


def correlation_expansion(gram: Float[Tensor, "L C W W"], data: Readings) -> Linearisation:
    """Gauss-Newton model of the sum of 1 - rho = |z - f|^2 / 2; z, f: centred readings and predictions of unit norm.

    gram: sums of products, see `Engine.gram`; W = P + 3.
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
    """Reshape (C,) or (L, C) such that it broadcasts against `like` (L, N, C)."""
    return per_channel if per_channel.dim() == 1 else per_channel.unsqueeze(1) if like.dim() == 3 else per_channel


def _rounding_variance(data: Readings) -> Tensor:
    """Variance of rounding errors, which keeps the logarithm of a perfect fit finite, (C,) or (L, C)."""
    variance = spread_of(data) / data.weight.sum(-2).clamp(min=1.0)
    return variance * ROUNDING_SHARE**2 + 1e-300


def _expect_variation(data: Readings) -> None:
    squares = spread_of(data)
    if not bool((squares > 0).all()):
        channel = int((squares <= 0).nonzero()[0, -1])
        raise ValueError(
            f"expected channels that vary, got a constant one (number {channel + 1}), whose correlation is undefined; "
            "use the objective 'likelihood' or leave the channel out"
        )
