"""Projection of linear parameters with normal priors out of whitened columns: N readings, P parameters."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

RIDGE = 1e-6  # minimum root of a prior precision; keeps parameters without information in place


def decomposed(
    jacobian: Float[Tensor, "N M"], pull: Float[Tensor, " P"]
) -> tuple[Float[Tensor, "NP rank"], Float[Tensor, "rank M"]]:
    """Orthonormal basis Q (N + P, M) of the influence of the parameters on readings and priors, and factor R (M, M).

    jacobian (N, M): whitened derivatives of the readings by the P parameters and by M - P further ones without a prior.
    pull (P,): root of the precision of the parameters' priors.
    """
    priors = torch.diag(pull.clamp(min=RIDGE))
    rows = torch.nn.functional.pad(priors, (0, jacobian.shape[1] - len(pull)))
    return torch.linalg.qr(torch.cat([jacobian, rows]))


def without(basis: Float[Tensor, "NP rank"], columns: Float[Tensor, "rows K"]) -> Float[Tensor, "NP K"]:
    """Columns less what the basis explains of them; rows: N + P, or N for columns with no influence on the priors."""
    columns = torch.nn.functional.pad(columns, (0, 0, 0, len(basis) - len(columns)))
    return columns - basis @ (basis.T @ columns)
