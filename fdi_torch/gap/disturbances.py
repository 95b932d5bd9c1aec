"""Random disturbances of the flows, as the readings of a subject show them beside what a fit explains."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.estimate.kalman import KalmanWhitening, Propagation, SensorNoise, StateNoise
from fdi_torch.estimate.state_noise import Likelihood, estimate_state_noise
from fdi_torch.gap.fitting import Fit, Fitter
from fdi_torch.gap.subject import between
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint_collocation import JointCollocation, with_blanks


def with_own_noise(
    fitter: Fitter, fit: Fit, start: StateNoise | None = None, climb: bool = True
) -> tuple[Fitter, Likelihood]:
    """The fitter under the noise that is most likely beside what a fit explains, and that noise.

    start: where the search for it begins; climb: whether its correlation time may change.
    """
    found = most_likely(fitter, fit, fit.near, start=start, climb=climb)
    return disturbed(fitter, fit, found.noise), found


def disturbed(fitter: Fitter, fit: Fit, noise: StateNoise) -> Fitter:
    """The fitter under this noise, which spreads along the trajectory of a fit."""
    whitening = KalmanWhitening(propagation_of(fitter, fit, fit.near), _sensors(fitter), noise)
    return Fitter(fitter.subject, fitter.noise, whitening)


def most_likely(
    fitter: Fitter,
    fit: Fit,
    near: Linearised,
    explained: Tensor | None = None,
    start: StateNoise | None = None,
    climb: bool = True,
) -> Likelihood:
    """The most likely noise about the neighbourhood `near`, beside the parameters of a fit.

    explained (S, C): what else is explained of the readings.
    """
    subject = fitter.subject
    scale, pull, off = fitter.priors(fit.space, fit.theta)
    propagation, sensors = propagation_of(fitter, fit, near), _sensors(fitter)
    residual = subject.readings - near.readings[0]
    if explained is not None:
        residual = residual - explained
    # A flow that moves a level by a tenth of its reading's noise from one sample to the next.
    gains = propagation.output.abs().amax(dim=0).amax(dim=-1).clamp(min=1e-12)
    unit = _areas(fitter) * float((sensors.std / gains).median()) / (10.0 * propagation.interval)
    return estimate_state_noise(propagation, sensors, residual, near.jacobian[0] * scale, pull, off, unit, start, climb)


def smoothed_levels(fitter: Fitter, fit: Fit) -> Tensor:
    """Levels (1, K+1, tanks) of all recordings as the readings and the model tell them together: the trajectory of the
    fit, and what its random flows have most likely done to it.
    """
    subject, levels = fitter.subject, fit.near.levels.clone()
    if fitter.disturbed is None:
        return levels
    moved = fitter.disturbed.smoothed(subject.readings - fit.near.readings[0])
    first = 0
    for part, rows in zip(subject.parts, subject.rows, strict=True):
        nodes = part.experiment.nodes
        at = [between(nodes, part.experiment.sample_times, x) for x in moved[rows].unbind(1)]
        levels[0, first : first + len(nodes)] += torch.stack(at, dim=1)
        first += len(nodes)
    return levels.clamp(min=0.0)


def propagation_of(fitter: Fitter, fit: Fit, near: Linearised) -> Propagation:
    """How flows into the tanks reach the readings along a trajectory; recordings follow each other."""
    subject = fitter.subject
    own = fitter.engine(fit.candidate, list(fit.effect_values))
    theta = fit.theta.unsqueeze(0)
    pieces = own.apart(theta, near) if isinstance(own, JointCollocation) else [(own, theta, near)]
    found = [_between_samples(engine, theta, piece, _areas(fitter)) for engine, theta, piece in pieces]
    transition, forcing, output = (with_blanks(each, dim=0) for each in zip(*found, strict=True))
    fresh = torch.zeros(len(subject.mask), dtype=torch.bool)
    fresh[[rows.start for rows in subject.rows]] = True
    interval = float(torch.median(torch.diff(subject.recording.time)))
    return Propagation(transition, forcing, output, interval, fresh, subject.mask)


def _between_samples(engine: Collocation, theta: Tensor, near: Linearised, areas: Tensor) -> Sequence[Tensor]:
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
        a, b = near.transition[0, step], near.gain[0, step] / areas
        forcing = torch.where(on, a @ forcing + b, forcing)
        transition = torch.where(on, a @ transition, transition)
    paths = one.reshape(1, n, n, 1).expand(1, n, n, len(experiment.nodes)).contiguous()
    output = engine.look(near.levels, theta).along(paths, [-1] * n)[0]
    return transition, forcing, output.permute(2, 0, 1)


def _sensors(fitter: Fitter) -> SensorNoise:
    return SensorNoise(fitter.noise.std, fitter.noise.alike)


def _areas(fitter: Fitter) -> Tensor:
    return torch.tensor([t.area for t in fitter.subject.plant.tanks], dtype=torch.float64)
