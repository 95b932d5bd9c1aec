"""Errors of constants: those calibrated on the fault-free part, where random flows look like errors, and all others."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.flow_noise_estimate import by_initial_levels
from fdi_torch.monitor.law_errors import ConstantErrors


def constant_errors(columns: Sequence[int], calibrated: int, flows: FlowFilter | None) -> ConstantErrors:
    """What is not known about constants in columns of a space: of the first `calibrated` ones, what least squares on
    the fault-free part left unknown (nothing without a flow filter); of the others, their tolerances.

    flows: learnt from the fault-free part beside the errors of all of them.
    """
    covariance = torch.eye(len(columns), dtype=torch.float64)
    covariance[:calibrated] = 0.0
    if calibrated and flows is not None:
        covariance[:calibrated, :calibrated] = covariance_of_least_squares(flows, flows.by_constants[..., :calibrated])
    return ConstantErrors(tuple(columns), covariance)


def covariance_of_least_squares(flows: FlowFilter, by_constants: Tensor) -> Tensor:
    """Covariance (P, P) of the errors of P constants that were estimated by least squares in a free run.

    by_constants (S, sensors, P): derivatives of the residuals of a free run by the constants, per standard deviation
    of their priors. These residuals are y = X x + G g + n, with initial levels x and errors g, each N(0, 1) in units of
    its prior, and the effect n of random flows and measurement noise. The error of an estimate E y is
    (E G - 1) g + E (X x + n).

    The most likely estimate beside random flows would have a smaller error, but only if the model is exact: it weighs
    the moments at which inputs step most, where each delay of an actuator counts as an error of its gain.
    """
    tanks = len(flows.start_std)
    weight = torch.isfinite(flows.learnt) / flows.innovation_std
    by_levels = by_initial_levels(flows.linear, len(weight))[..., :tanks] * flows.start_std
    both = torch.cat([by_levels, by_constants], -1) * weight.unsqueeze(-1)
    x, eye = both.flatten(0, 1), torch.eye(both.shape[-1], dtype=both.dtype)
    estimate = torch.linalg.solve(x.mT @ x + eye, x.mT)[tanks:]
    error = estimate @ x - eye[tanks:]
    return error @ error.mT + flows.covariance_of_sums(estimate.reshape(-1, *weight.shape) * weight)
