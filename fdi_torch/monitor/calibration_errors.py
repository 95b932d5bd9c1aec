"""Errors of constants that were calibrated on the fault-free part, in which random flows and noise look like errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.flow_noise_estimate import by_initial_levels, free_residual
from fdi_torch.monitor.law_errors import STEP, ConstantErrors, raised
from fdi_torch.monitor.noise_model import NoiseModel
from fdi_torch.monitor.observer import Observation, Observer
from fdi_torch.monitor.samples import Samples
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork


def calibration_errors(
    network: TankNetwork,
    fault_free: Samples,
    space: ParameterSpace,
    theta: Tensor,
    names: Sequence[str],
    noise: NoiseModel,
    seen: Observation,
    longest_step: float | None = None,
) -> ConstantErrors:
    """What the fault-free part leaves unknown about the constants `names` of `space`, whose least-squares estimates are
    in theta (P,). Without a flow filter they count as exact.

    noise, seen: learnt with theta from the same samples, and the run of its observer.
    """
    if noise.whitening.flows is None or not names:
        return ConstantErrors()
    columns = [space.index(name) for name in names]
    lanes = raised(theta, space, columns)
    every = replace(fault_free, readings=fault_free.readings.expand(len(lanes), *fault_free.readings.shape))
    moved = Observer(network, noise.gain, space, lanes, longest_step).run(every)
    effects = (moved.steady_residual - seen.steady_residual) / STEP
    return ConstantErrors(tuple(columns), covariance_of_least_squares(noise.whitening.flows, effects))


def covariance_of_least_squares(flows: FlowFilter, effects: Tensor) -> Tensor:
    """Covariance (P, P) of the errors of P constants that were estimated by least squares in a free run.

    effects (P, S, sensors): of the constants, per standard deviation of their priors, on the residuals of the observer.
    The residuals of a free run are y = X x + G g + n, with initial levels x and errors g, each N(0, 1) in units of its
    prior, and the effect n of random flows and measurement noise. The error of an estimate E y is
    (E G - 1) g + E (X x + n).

    The most likely estimate beside random flows would have a smaller error, but only if the model is exact: it weighs
    the moments at which inputs step most, where each delay of an actuator counts as an error of its gain.
    """
    by_constants, tanks = free_residual(flows.linear, flows.observer, effects), len(flows.start_std)
    weight = torch.isfinite(by_constants[0]) / flows.innovation_std
    by_levels = by_initial_levels(flows.linear, len(weight))[..., :tanks] * flows.start_std
    both = torch.cat([by_levels, by_constants.nan_to_num().permute(1, 2, 0)], -1) * weight.unsqueeze(-1)
    x, eye = both.flatten(0, 1), torch.eye(both.shape[-1], dtype=both.dtype)
    estimate = torch.linalg.solve(x.mT @ x + eye, x.mT)[tanks:]
    error = estimate @ x - eye[tanks:]
    return error @ error.mT + flows.covariance_of_sums(estimate.reshape(len(effects), *weight.shape) * weight)
