"""Standard errors of a fit's parameters: the inverse of its curvature, tolerances included."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.gap.fitting import Fit, Fitter


def covariance(fitter: Fitter, fit: Fit) -> Tensor:
    """(P, P) of the fit's parameters, in their units."""
    scale = fitter.box(fit.space)[2]
    curvature = fitter.normal(fit.space, fit.theta.unsqueeze(0), fit.near, scale)[2][0]
    return torch.linalg.pinv(curvature, hermitian=True) * scale * scale.unsqueeze(1)


def standard_errors(fitter: Fitter, fit: Fit) -> dict[str, float]:
    """By full name."""
    variance = torch.diagonal(covariance(fitter, fit)).clamp(min=0.0)
    return dict(zip(fit.space.names, torch.sqrt(variance).tolist(), strict=True))
