"""Marginal likelihood (evidence) of an explanation, with the random flow disturbances that are most likely with it.

    log E = -J / 2 - log det(V) / 2 - log det(H) / 2 + sum of the log prior densities of the parameters + log prior odds

J is chi-square of the innovations including the priors, V the covariance of the innovations, H the curvature of J / 2
(Laplace's approximation). Disturbances are estimated anew for each explanation: a wrong equation acts as a disturbance,
and costs as much as a disturbance of that size.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import log_prior as prior_of_set
from fdi_torch.estimate.evidence import log_volume
from fdi_torch.estimate.kalman import KalmanFilter, KalmanWhitening, Propagation
from fdi_torch.estimate.linearisation import held_back
from fdi_torch.estimate.noise_model import SensorNoise, StateNoise
from fdi_torch.estimate.state_noise import Likelihood, estimate_state_noise
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate import Candidate, Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.recomputed import Recomputed
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.joint_collocation import with_blanks
from fdi_torch.simulate.linearised import Linearised


@dataclass(frozen=True)
class LinearParameters:
    """Parameters in which the readings are linear. columns (S, C, M): derivatives of the readings by them. pull (M,):
    root of the precision of their normal priors about zero."""

    columns: Tensor
    pull: Tensor


def with_estimated_noise(
    fitter: Fitter, fit: Fit, start: StateNoise | None = None, climb: bool = True
) -> tuple[Fitter, Likelihood]:
    """The fitter with the disturbance noise that is most likely with a fit, and that noise.

    start: initial noise of the optimisation. climb: whether the correlation time may change.
    """
    likely = estimate_disturbances(fitter, fit, fit.linearised, start=start, climb=climb)
    return with_disturbances(fitter, fit, likely.noise), likely


def with_disturbances(fitter: Fitter, fit: Fit, noise: StateNoise, linearised: Linearised | None = None) -> Fitter:
    """The fitter with this disturbance noise, propagated along a linearised trajectory, by default that of the fit."""

    def whitening() -> KalmanWhitening:
        along = propagation_of(fitter.data, fit, linearised or fit.linearised)
        return KalmanFilter(along, _sensors(fitter)).under(noise)

    return Fitter(fitter.data, fitter.noise, Recomputed(whitening))


def estimate_disturbances(
    fitter: Fitter,
    fit: Fit,
    linearised: Linearised,
    further: LinearParameters | None = None,
    start: StateNoise | None = None,
    climb: bool = True,
) -> Likelihood:
    """The most likely disturbance noise about a linearised trajectory, with the parameters of a fit integrated out.

    further: coefficients that are integrated out as well.
    """
    data = fitter.data
    scale, weight, deviation = fitter.priors(fit.space, fit.theta)
    propagation, sensors = propagation_of(data, fit, linearised), _sensors(fitter)
    residual, jacobian = data.readings - linearised.readings[0], linearised.jacobian[0] * scale
    if further is not None:
        jacobian = torch.cat([jacobian, further.columns], dim=-1)
        weight, deviation = torch.cat([weight, further.pull]), torch.cat([deviation, torch.zeros_like(further.pull)])
    # Unit of the flows: it moves a level by a tenth of the sensor noise from one sample to the next.
    gains = propagation.output.abs().amax(dim=0).amax(dim=-1).clamp(min=1e-12)
    unit = _areas(data) * float((sensors.std / gains).median()) / (10.0 * propagation.usual_interval)
    return estimate_state_noise(propagation, sensors, residual, jacobian, weight, deviation, unit, start, climb)


@lru_cache(maxsize=2)  # several noise models in succession, with the trajectory of the fit between
def propagation_of(data: DataSet, fit: Fit, linearised: Linearised) -> Propagation:
    """Propagation of flow disturbances to the readings along a trajectory, for all recordings in sequence."""
    matrices = [_between_samples(*piece, _areas(data)) for piece in fit.pieces(linearised)]
    transition, forcing, output = (with_blanks(each, dim=0) for each in zip(*matrices, strict=True))
    starts = torch.zeros(len(data.mask), dtype=torch.bool)
    starts[[rows.start for rows in data.rows]] = True
    interval = torch.full((len(data.mask),), data.row_spacing, dtype=torch.float64)
    for rows, experiment in zip(data.rows, data.experiments, strict=True):
        interval[rows.start : rows.stop - 1] = torch.diff(experiment.sample_times)
    return Propagation(transition, forcing, output, interval, starts, data.mask)


def _between_samples(engine: Collocation, theta: Tensor, linearised: Linearised, areas: Tensor) -> Sequence[Tensor]:
    """Transition (S, n, n), forcing (S, n, n) and output (S, C, n) between the samples of one recording."""
    experiment, n = engine.experiment, engine.network.order
    areas = torch.cat([areas, areas.new_full((n - len(areas),), torch.inf)])  # no random flow acts on other states
    node = experiment.sample_step + experiment.sample_share.round().to(torch.int64)
    steps = torch.cat([torch.diff(node), node.new_zeros(1)])
    identity = torch.eye(n, dtype=torch.float64)
    transition, forcing = identity.repeat(len(node), 1, 1), torch.zeros(len(node), n, n, dtype=torch.float64)
    for offset in range(int(steps.max())):
        rows = torch.nonzero(steps > offset).squeeze(1)  # few samples are more than one or two steps apart
        step = node[rows] + offset
        a, b = linearised.transition[0].index_select(0, step), linearised.gain[0].index_select(0, step) / areas
        transition[rows], forcing[rows] = a @ transition[rows], a @ forcing[rows] + b
    paths = identity.reshape(1, n, n, 1).expand(1, n, n, len(experiment.nodes)).contiguous()
    output = engine.look(linearised.levels, theta).along(paths, [-1] * n)[0]
    return transition, forcing, output.permute(2, 0, 1)


def _sensors(fitter: Fitter) -> SensorNoise:
    return SensorNoise(fitter.noise.std, fitter.noise.lag_one)


def _areas(data: DataSet) -> Tensor:
    return torch.tensor([t.area for t in data.plant.tanks], dtype=torch.float64)


def log_evidence(fitter: Fitter, fit: Fit, choices: int) -> float:
    """Log evidence of a fit under its own noise. choices: number of effects at places in the library.

    Minus infinity for a fit whose likelihood is not finite.
    """
    residual, jacobian = (x[0] for x in fitter.white(fit.linearised))
    likelihood = -0.5 * fit.cost - 0.5 * fitter.log_det
    if not (math.isfinite(likelihood) and bool(jacobian.isfinite().all())):
        return -math.inf
    return likelihood + occam(fitter, fit.space, fit.theta, jacobian, residual) + log_prior(fit.key, choices)


def evidence_under(fitter: Fitter, fit: Fit, choices: int) -> float:
    """Log evidence of a fit under the noise of a fitter, which may differ from that of its descent."""
    return log_evidence(fitter, replace(fit, cost=fitter.cost(fit)), choices)


def with_likeliest_parameters(fitter: Fitter, fit: Fit, starts: Sequence[Mapping[str, float]], choices: int) -> Fit:
    """The fit with its own parameters of effects, or refitted with fewer, those of one of the starts.

    By chance, an onset lowers the cost of an effect that was there from the start.
    """
    values, evidence = fit.effect_values, evidence_under(fitter, fit, choices)
    likeliest = fit
    for free in dict.fromkeys(tuple(sorted(s)) for s in starts):
        if set(free) < values.keys():
            fewer = fitter.fit(Candidate(fit.candidate.placements, ({name: values[name] for name in free},)), fit)
            if (of_fewer := evidence_under(fitter, fewer, choices)) > evidence:
                likeliest, evidence = fewer, of_fewer
    return likeliest


def occam(
    fitter: Fitter, space: ParameterSpace, theta: Tensor, jacobian: Tensor, residual: Tensor | None = None
) -> float:
    """Log of the volume of the posterior over that of the prior (Occam factor).

    jacobian (S, C, P): whitened. residual (S, C): whitened, if the bounds of the parameters are counted.
    """
    j, widths = jacobian.flatten(0, 1), [math.exp(log_width(fitter, space, i)) for i in range(len(space))]
    slope = None if residual is None else slope_at_bounds(fitter, space, theta, jacobian, residual)
    return log_volume(j.T @ j + torch.diag(space.std(theta) ** -2.0), torch.tensor(widths, dtype=torch.float64), slope)


def slope_at_bounds(fitter: Fitter, space: ParameterSpace, theta: Tensor, jacobian: Tensor, residual: Tensor) -> Tensor:
    """Magnitude (P,) of the derivatives of half of chi-square by the parameters that a bound holds back, 0 for others.

    The posterior of such a parameter lies between its bound and the inside of its range only. residual (S, C),
    jacobian (S, C, P): whitened.
    """
    gradient = (theta - space.nominal(theta)) / space.std(theta) ** 2 - jacobian.flatten(0, 1).T @ residual.flatten()
    low, high, _ = fitter.box(space)
    held = held_back(theta[None], gradient[None], low[None], high[None])[0]
    return torch.where(held, gradient.abs(), 0.0)


def log_prior(causes: Iterable[CauseName], choices: int) -> float:
    """Log prior of a set of effects, by its size, its places, and the number of choices."""
    causes = list(causes)
    return prior_of_set(len(causes), len({place for _, place in causes}), choices)


def log_width(fitter: Fitter, space: ParameterSpace, i: int) -> float:
    """Log of the width of a parameter's prior: one over its density, at the mean of a normal one."""
    p = space.parameters[i]
    if math.isfinite(p.std):
        return math.log(p.std * math.sqrt(2.0 * math.pi))
    low, high, _ = fitter.box(space)
    width = float(high[i] - low[i])
    return math.log(width) if math.isfinite(width) else 0.0
