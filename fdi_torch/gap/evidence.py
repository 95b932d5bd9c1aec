"""Laplace's evidence of an explanation under its own noise, and what is believed before the data.

    log E = -J / 2 - log det(V) / 2 - log det(H) / 2 + sum of the log prior densities of the parameters + log prior odds

J is the chi-square of the innovations with the tolerances' share, V their variances, H the curvature of J / 2. The
noise is the most likely one beside the explanation: what an equation gets wrong is random to it, and costs what noise
of that size costs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from fdi_torch.estimate.evidence import log_det
from fdi_torch.estimate.evidence import log_prior as prior_of_set
from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.fitting import Fit, Fitter
from fdi_torch.parameters import ParameterSpace


def log_evidence(fitter: Fitter, fit: Fit, choices: int) -> float:
    """choices: how many effects at places the library holds. fitter: under the noise of this fit.

    Minus infinity for a fit that ran off to where the model has no numbers.
    """
    jacobian = fitter.white(fit.near)[1][0]
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
