"""Random disturbances of the flows, as the readings of a subject show them beside what a fit explains."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import log_det
from fdi_torch.estimate.evidence import log_prior as prior_of_set
from fdi_torch.estimate.kalman import KalmanWhitening, Propagation, SensorNoise, StateNoise
from fdi_torch.estimate.state_noise import Likelihood, estimate_state_noise
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.dataset import interpolate
from fdi_torch.parameters import ParameterSpace
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint_collocation import JointCollocation, with_blanks


def with_estimated_noise(
    fitter: Fitter, fit: Fit, start: StateNoise | None = None, climb: bool = True
) -> tuple[Fitter, Likelihood]:
    """The fitter under the noise that is most likely beside what a fit explains, and that noise.

    start: where the search for it begins; climb: whether its correlation time may change.
    """
    found = estimate_disturbances(fitter, fit, fit.linearised, start=start, climb=climb)
    return with_disturbances(fitter, fit, found.noise), found


def with_disturbances(fitter: Fitter, fit: Fit, noise: StateNoise) -> Fitter:
    """The fitter under this noise, which spreads along the trajectory of a fit."""
    whitening = KalmanWhitening(propagation_of(fitter, fit, fit.linearised), _sensors(fitter), noise)
    return Fitter(fitter.data, fitter.noise, whitening)


def estimate_disturbances(
    fitter: Fitter,
    fit: Fit,
    linearised: Linearised,
    explained: Tensor | None = None,
    start: StateNoise | None = None,
    climb: bool = True,
) -> Likelihood:
    """The most likely noise about the neighbourhood `near`, beside the parameters of a fit.

    explained (S, C): what else is explained of the readings.
    """
    data = fitter.data
    scale, pull, off = fitter.priors(fit.space, fit.theta)
    propagation, sensors = propagation_of(fitter, fit, linearised), _sensors(fitter)
    residual = data.readings - linearised.readings[0]
    if explained is not None:
        residual = residual - explained
    # A flow that moves a level by a tenth of its reading's noise from one sample to the next.
    gains = propagation.output.abs().amax(dim=0).amax(dim=-1).clamp(min=1e-12)
    unit = _areas(fitter) * float((sensors.std / gains).median()) / (10.0 * propagation.interval)
    return estimate_state_noise(
        propagation, sensors, residual, linearised.jacobian[0] * scale, pull, off, unit, start, climb
    )


def smoothed_levels(fitter: Fitter, fit: Fit) -> Tensor:
    """Levels (1, K+1, tanks) of all recordings as the readings and the model tell them together: the trajectory of the
    fit, and what its random flows have most likely done to it.
    """
    data, levels = fitter.data, fit.linearised.levels.clone()
    if fitter.whitening is None:
        return levels
    moved = fitter.whitening.smoothed(data.readings - fit.linearised.readings[0])
    first = 0
    for part, rows in zip(data.parts, data.rows, strict=True):
        nodes = part.experiment.nodes
        at = [interpolate(nodes, part.experiment.sample_times, x) for x in moved[rows].unbind(1)]
        levels[0, first : first + len(nodes)] += torch.stack(at, dim=1)
        first += len(nodes)
    return levels.clamp(min=0.0)


def propagation_of(fitter: Fitter, fit: Fit, linearised: Linearised) -> Propagation:
    """How flows into the tanks reach the readings along a trajectory; recordings follow each other."""
    data = fitter.data
    own = fitter.engine(fit.candidate, list(fit.effect_values))
    theta = fit.theta.unsqueeze(0)
    pieces = own.apart(theta, linearised) if isinstance(own, JointCollocation) else [(own, theta, linearised)]
    found = [_between_samples(engine, theta, piece, _areas(fitter)) for engine, theta, piece in pieces]
    transition, forcing, output = (with_blanks(each, dim=0) for each in zip(*found, strict=True))
    fresh = torch.zeros(len(data.mask), dtype=torch.bool)
    fresh[[rows.start for rows in data.rows]] = True
    return Propagation(transition, forcing, output, data.row_spacing, fresh, data.mask)


def _between_samples(engine: Collocation, theta: Tensor, linearised: Linearised, areas: Tensor) -> Sequence[Tensor]:
    """Transition (S, n, n), forcing (S, n, n) and output (S, C, n) of one recording; the last sample has no next."""
    experiment, n = engine.experiment, len(areas)
    node = experiment.sample_step + experiment.sample_share.round().to(torch.int64)
    until = torch.cat([node[1:], node[-1:]])
    one = torch.eye(n, dtype=torch.float64)
    transition, forcing = one.repeat(len(node), 1, 1), torch.zeros(len(node), n, n, dtype=torch.float64)
    for turn in range(int((until - node).max())):
        step = node + turn
        on = (step < until)[:, None, None]
        step = step.clamp(max=len(experiment.steps) - 1)
        a, b = linearised.transition[0, step], linearised.gain[0, step] / areas
        forcing = torch.where(on, a @ forcing + b, forcing)
        transition = torch.where(on, a @ transition, transition)
    paths = one.reshape(1, n, n, 1).expand(1, n, n, len(experiment.nodes)).contiguous()
    output = engine.look(linearised.levels, theta).along(paths, [-1] * n)[0]
    return transition, forcing, output.permute(2, 0, 1)


def _sensors(fitter: Fitter) -> SensorNoise:
    return SensorNoise(fitter.noise.std, fitter.noise.alike)


def _areas(fitter: Fitter) -> Tensor:
    return torch.tensor([t.area for t in fitter.data.plant.tanks], dtype=torch.float64)


def log_evidence(fitter: Fitter, fit: Fit, choices: int) -> float:
    """choices: how many effects at places the library holds. fitter: under the noise of this fit.

    Minus infinity for a fit that ran off to where the model has no numbers.
    """
    jacobian = fitter.white(fit.linearised)[1][0]
    likelihood = -0.5 * fit.cost - 0.5 * fitter.log_det
    if not (math.isfinite(likelihood) and bool(jacobian.isfinite().all())):
        return -math.inf
    return likelihood + occam(fitter, fit.space, fit.theta, jacobian) + log_prior(fit.key, choices)


def occam(fitter: Fitter, space: ParameterSpace, theta: Tensor, jacobian: Tensor) -> float:
    """What the parameters cost: the volume of the posterior over that of the prior. jacobian (S, C, P): whitened."""
    scale = fitter.box(space)[2]
    j = (jacobian * scale).flatten(0, 1)
    pull = torch.nan_to_num(scale / space.std(theta), posinf=0.0)
    widths = torch.tensor([_log_width(fitter, space, i) for i in range(len(space))], dtype=torch.float64)
    return -0.5 * log_det(j.T @ j + torch.diag(pull**2)) + float((torch.log(scale) - widths).sum())


def log_prior(causes: Iterable[CauseName], choices: int) -> float:
    """How many effects there are, and which of the choices."""
    causes = list(causes)
    return prior_of_set(len(causes), len({place for _, place in causes}), choices)


def _log_width(fitter: Fitter, space: ParameterSpace, i: int) -> float:
    """Log of the width of a parameter's prior over sqrt(2 pi), in its unit."""
    p = space.parameters[i]
    if math.isfinite(p.std):
        return math.log(p.std)
    low, high, _ = fitter.box(space)
    width = float(high[i] - low[i])
    return math.log(width if math.isfinite(width) else 1.0) - 0.5 * math.log(2.0 * math.pi)
