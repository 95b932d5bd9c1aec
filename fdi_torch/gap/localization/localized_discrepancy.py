"""A discrepancy at one component, its weight, and what is no discrepancy: a rounding error."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.linear_parameters import decomposed, without
from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_columns import Selection
from fdi_torch.gap.localization.predicted_levels import LevelFilter
from fdi_torch.gap.localization.regressors import HARMONICS
from fdi_torch.gap.marginal_likelihood import occam, slope_at_bounds, with_disturbances
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.linearised import Linearised

ROUNDED = 1e-3  # rounding errors of readings and their derivatives that count as none, in units of the sensor noise
COLLINEAR = 1e-12  # minimum share of a parameter's variance that others leave, a limit of rounding


@dataclass(frozen=True)
class Estimate:
    """Most likely values (P,) of a fit's parameters, and their covariance (P, P)."""

    values: Tensor
    covariance: Tensor

    @staticmethod
    def beside(under: Fitter, fit: Fit, linearised: Linearised, columns: Tensor, precision: Tensor) -> Estimate:
        """First-order estimate of the parameters together with the coefficients of columns (S, C, M).

        precision (M,): of the normal priors of the coefficients.
        """
        residual, jacobian = (x[0] for x in under.white(linearised))
        scale, pull, off = under.priors(fit.space, fit.theta)
        rows = torch.cat([jacobian * scale, under.whiten(columns)], dim=-1).flatten(0, 1)
        basis, factor = decomposed(rows, torch.cat([pull, precision.sqrt()]))
        inverse = torch.linalg.solve_triangular(factor, torch.eye(len(factor)).to(factor), upper=True)[: len(scale)]
        right = torch.cat([residual.flatten(), -off, torch.zeros_like(precision)])
        scaled = scale.unsqueeze(1) * inverse
        return Estimate(fit.theta + scaled @ (basis.T @ right), scaled @ scaled.T)

    def log_density(
        self, i: int, value: float, bounds: tuple[float, float], held: Mapping[int, float] | None = None
    ) -> float:
        """Log density of parameter i at a value: that of a normal distribution truncated at its bounds.

        held: given values of other parameters. If the readings show nothing of the parameter, the density is uniform
        between its bounds.
        """
        size = torch.sqrt(torch.diagonal(self.covariance))
        correlation, others = self.covariance / size / size.unsqueeze(1), list(held or ())
        shared = torch.linalg.pinv(correlation[others][:, others], hermitian=True) @ correlation[others, i]
        left = 1.0 - float(correlation[i, others] @ shared)
        std = float(size[i]) * math.sqrt(max(left, COLLINEAR))
        moved = (torch.tensor(list((held or {}).values())).to(self.values) - self.values[others]) / size[others]
        mean = float(self.values[i] + size[i] * (shared @ moved))
        low, z, high = ((x - mean) / std for x in (bounds[0], value, bounds[1]))
        below, above = (torch.tensor([low, high]) if low + high < 0.0 else torch.tensor([-high, -low])).double()
        above, below = torch.special.log_ndtr(above), torch.special.log_ndtr(below)
        mass = float(above + torch.log(-torch.expm1(below - above)))
        return -0.5 * z * z - math.log(std * math.sqrt(2.0 * math.pi)) - mass


@dataclass(frozen=True)
class LocalizedDiscrepancy:
    """A discrepancy at one component, in addition to a fit.

    gain: increase of the log evidence over that of the fit alone, without prior odds. log_likelihood: increase of the
    log-likelihood, by `parameters`, its effective number of parameters. explained (S, C): its influence on the
    readings; zero for a random process. predicted (S, C): the readings with it; None for a random process. size: norm
    of the part of it that no parameter of the fit explains, in units of the sensor noise. selection: its regressors;
    None for a random process. fit, noise: the fit and the most likely disturbance noise, both estimated with the
    discrepancy. estimate: of the fit's parameters beside it. level_filter: predicts the levels about which the plant is
    linearised. quantities: what it changes: 'area' (of a tank), 'flow' (or the reading of a sensor), or both.
    """

    location: str
    gain: float
    log_likelihood: float
    parameters: float
    explained: Tensor
    predicted: Tensor | None
    size: float
    selection: Selection | None
    fit: Fit
    noise: StateNoise
    estimate: Estimate
    level_filter: LevelFilter
    quantities: frozenset[str] = frozenset({"flow"})

    @property
    def pulses(self) -> tuple[tuple[float, float], ...]:
        """Period and duration of the pulses, s."""
        positions = self.selection.positions if self.selection else ()
        return tuple(
            (1.0 / p.frequency, p.parameters[2] / p.frequency) for p in positions if p.frequency and p.parameters
        )

    @property
    def periods(self) -> tuple[float, ...]:
        """Periods of the sinusoids, and of the pulses with their harmonics, s."""
        sinusoids = (1.0 / frequency for frequency in (self.selection.frequencies if self.selection else ()))
        first = dict.fromkeys((*sinusoids, *(period for period, _ in self.pulses)))
        return tuple(period / k for period in first for k in range(1, HARMONICS + 1))


def log_likelihood(fitter: Fitter, fit: Fit, linearised: Linearised, bounded: bool = True) -> float:
    """Log evidence of a fit about a linearised trajectory, without prior odds.

    bounded: whether parameters that a bound holds back stay there; beside a discrepancy they may leave it. Minus
    infinity if it is not finite, or if the innovations are lost to rounding. A plant linearised about levels that are
    none of its trajectories may be unstable: where the cross-section of a tank falls to a tenth within millimetres,
    deviations grew by a factor of 100 per second, up to 1e57 m. Such innovations are rounding errors, or exactly zero.
    """
    space, theta = fit.space, fit.theta
    residual, jacobian = (x[0] for x in fitter.white(linearised))
    scale, pull, off = fitter.priors(space, theta)
    columns = torch.cat([linearised.readings[0].unsqueeze(-1), linearised.jacobian[0] * scale], dim=-1)
    largest = float((columns.abs().amax(dim=(0, 2)) / fitter.noise.std).max())
    in_noise = largest * torch.finfo(columns.dtype).eps
    total = fitter.log_det + float(residual.square().sum() + jacobian.square().sum())
    if not (math.isfinite(total) and in_noise < ROUNDED):
        return -math.inf
    free = slope_at_bounds(fitter, space, theta, jacobian, residual) == 0.0 if bounded else torch.ones_like(off) > 0.0
    basis, _ = decomposed((jacobian * scale)[..., free].flatten(0, 1), pull[free])
    remaining = without(basis, torch.cat([residual.flatten(), -off[free]]).unsqueeze(1))
    chi_square = float(remaining.square().sum() + off[~free].square().sum())
    return -0.5 * (chi_square + fitter.log_det) + occam(fitter, space, theta, jacobian, residual if bounded else None)


def log_evidence(fitter: Fitter, fit: Fit, noise: StateNoise, linearised: Linearised) -> float:
    """Log evidence of a fit and a noise model about a linearised trajectory, without prior odds."""
    return log_likelihood(with_disturbances(fitter, fit, noise, linearised), fit, linearised) + noise.log_prior()


def nearly_without_disturbances(noise: StateNoise) -> StateNoise:
    """The noise with nearly no random flow into any tank."""
    return replace(noise, intensity=(0.1 * noise.intensity.min()).expand_as(noise.intensity).clone())


def unexplained_norm(
    fitter: Fitter, space: ParameterSpace, theta: Tensor, jacobian: Tensor, deviation: Tensor
) -> float:
    """Norm, in units of the sensor noise, of the part of a deviation that no parameter within its tolerance explains.

    deviation (S, C): of the readings. jacobian (S, C, P): their derivatives by the parameters at theta. A parameter at
    a bound explains nothing.
    """
    scale, pull, _ = fitter.priors(space, theta)
    low, high, _ = fitter.box(space)
    free = scale * ((theta > low) & (theta < high))
    basis, _ = decomposed(fitter.noise.whiten(jacobian, fitter.data.mask).flatten(0, 1) * free, pull)
    column = fitter.noise.whiten(deviation, fitter.data.mask).flatten().unsqueeze(1)
    return float(torch.linalg.vector_norm(without(basis, column)))


def is_rounding_error(fitter: Fitter, place: str, std: float) -> bool:
    """Whether a deviation of a sensor with this standard deviation may be a rounding error: up to half a step.

    It is a function of the level, and varies slowly where the level does.
    """
    sensors, steps = [s.name for s in fitter.data.plant.sensors], fitter.noise.steps
    return bool(steps) and place in sensors and std < 0.5 * steps[sensors.index(place)]
