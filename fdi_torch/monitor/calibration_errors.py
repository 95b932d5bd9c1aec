"""Errors of constants: those calibrated on the fault-free part, where random flows look like errors, and all others."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.flow_noise_estimate import by_initial_levels, free_residual
from fdi_torch.monitor.law_errors import ConstantErrors


def constant_errors(
    columns: Sequence[int], effects: Tensor, flows: FlowFilter | None, expected: Tensor
) -> ConstantErrors:
    """What is not known about constants in columns of a space: of the first ones, which are calibrated, what least
    squares on the fault-free part left unknown (nothing without a flow filter); of the others, their tolerances.

    effects (P, S, sensors): of the P calibrated ones on the residuals of the fault-free part, per standard deviation of
    their priors. expected: means of the priors of the others, in these standard deviations from the values in use.
    """
    covariance, count = torch.eye(len(columns), dtype=torch.float64), len(effects)
    covariance[:count] = 0.0
    if count and flows is not None:
        covariance[:count, :count] = covariance_of_least_squares(flows, effects)
    return ConstantErrors(tuple(columns), covariance, count, torch.cat([expected.new_zeros(count), expected]))


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
