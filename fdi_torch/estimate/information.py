"""Fisher information, covariance (Cramer-Rao bound) and undetermined directions of an estimate.

The information matrix is scaled to a unit diagonal first, so that the rank decision does not depend on the units and
magnitudes of the parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float

from fdi_torch.estimate.batch_algebra import row_sum

# A direction is undetermined if its eigenvalue of the scaled information is below this fraction of the largest one.
RELATIVE_EIGENVALUE = 1e-10
# A parameter belongs to the undetermined subspace if its diagonal element of the projector exceeds this.
_SHARE = 1e-6


def fisher_information(
    jacobian: Float[torch.Tensor, "*batch S C P"], noise_std: Float[torch.Tensor, "*#batch C"]
) -> Float[torch.Tensor, "*batch P P"]:
    """Fisher information (*batch, P, P) for independent Gaussian noise: sum of J J' / sigma^2 over all readings.

    jacobian (*batch, S, C, P): derivatives of the readings. noise_std (*batch, C): in each reading's unit.
    """
    rows = (jacobian / noise_std[..., None, :, None]).flatten(-3, -2)
    return rows.mT @ rows


@dataclass(frozen=True)
class Certainty:
    """Covariance and undetermined directions that follow from an information matrix.

    std (*batch, P): standard errors; infinite for a parameter that belongs to an undetermined direction.
    covariance (*batch, P, P): for such a parameter infinite on the diagonal and NaN elsewhere in its row and column.
    determined (*batch, P, P): covariance within the determined subspace; that of any determined combination follows
    from it.
    null (*batch, P, P): projector onto the undetermined subspace, for scaled parameters; zero if there is none.
    scale (*batch, P): parameter = scale * scaled parameter.
    """

    std: torch.Tensor
    covariance: torch.Tensor
    determined: torch.Tensor
    null: torch.Tensor
    scale: torch.Tensor


def certainty(
    information: Float[torch.Tensor, "*batch P P"],
    held: Bool[torch.Tensor, "*batch P"] | None = None,
) -> Certainty:
    """Covariance from the Fisher information (*batch, P, P), priors included: the Cramer-Rao bound at the estimate.

    held (*batch, P) bool: parameters taken as exactly known, such as those at an active bound. Their standard error is
    0 and they do not contribute to that of the others.
    """
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(diagonal > 0, 1.0 / torch.where(diagonal > 0, diagonal, 1.0).sqrt(), 1.0)
    scaled = information * scale[..., :, None] * scale[..., None, :]
    scaled = 0.5 * (scaled + scaled.mT)
    if held is not None:
        # Decouple held parameters from the others, with unit information; `_certainty_from` sets their covariance to 0.
        involves_held = held[..., :, None] | held[..., None, :]
        scaled = torch.where(involves_held, torch.eye(scaled.shape[-1]).to(scaled), scaled)
    not_finite = ~torch.isfinite(scaled).all(-1).all(-1)[..., None, None]
    values, vectors = _eigen(torch.where(not_finite, torch.zeros_like(scaled), scaled))
    undetermined = (values <= RELATIVE_EIGENVALUE * values[..., -1:].clamp(min=0.0)) | (values <= 0)
    inverse = torch.where(undetermined, 0.0, 1.0 / torch.where(undetermined, 1.0, values))
    null = _recompose(vectors, undetermined.to(vectors))
    covariance = _recompose(vectors, inverse) * scale[..., :, None] * scale[..., None, :]
    return _certainty_from(covariance, null, scale, held)


def _eigen(matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Eigenvalues (*batch, P) in ascending order and eigenvectors (*batch, P, P) of symmetric matrices.

    Decomposed one by one, each in its own memory, because the rounding of the library depends on memory alignment.
    """
    parameters = matrix.shape[-1]
    pairs = [torch.linalg.eigh(one.clone()) for one in matrix.reshape(-1, parameters, parameters)]
    values, vectors = (torch.stack(parts) for parts in zip(*pairs, strict=True))
    return values.reshape(matrix.shape[:-1]), vectors.reshape(matrix.shape)


def _recompose(vectors: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """V diag(values) V', (*batch, P, P), summed in an order that does not depend on the batch."""
    return row_sum(vectors[..., :, None, :] * vectors[..., None, :, :] * values[..., None, None, :])


def _certainty_from(
    covariance: torch.Tensor, null: torch.Tensor, scale: torch.Tensor, held: torch.Tensor | None
) -> Certainty:
    """Set the covariance of undetermined parameters to infinity or NaN, and that of held ones to zero."""
    undetermined = null.diagonal(dim1=-2, dim2=-1) > _SHARE
    involved = undetermined[..., :, None] | undetermined[..., None, :]
    determined = covariance
    covariance = torch.where(involved, math.nan, covariance)
    covariance = torch.where(torch.diag_embed(undetermined), math.inf, covariance)
    if held is not None:
        involves_held = held[..., :, None] | held[..., None, :]
        covariance, determined = (torch.where(involves_held, 0.0, c) for c in (covariance, determined))
    return Certainty(covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt(), covariance, determined, null, scale)


def determined_combinations(
    null: Float[torch.Tensor, "P P"], scale: Float[torch.Tensor, " P"]
) -> list[tuple[list[int], torch.Tensor]]:
    """Groups of parameters that are jointly undetermined, with the linear combinations of them that are determined.

    null (P, P), scale (P,): from one `Certainty`. Returns for each group the indices of its m parameters and the
    coefficients (m - k, m) of the determined combinations in reduced row echelon form; k is the number of undetermined
    directions in the group.
    """
    groups = []
    for members in _groups(null):
        block = null[members][:, members]
        values, vectors = torch.linalg.eigh(block)
        determined = vectors[:, values < 0.5].mT / scale[members]
        groups.append((members, _reduced(determined)))
    return groups


def _groups(null: torch.Tensor) -> list[list[int]]:
    """Groups of parameters that share an undetermined direction: connected components of the projector `null`."""
    remaining = [i for i in range(len(null)) if null[i, i] > _SHARE]
    groups = []
    while remaining:
        group = [remaining.pop(0)]
        for member in group:
            linked = [j for j in remaining if abs(float(null[member, j])) > math.sqrt(_SHARE) * 0.1]
            remaining = [j for j in remaining if j not in linked]
            group += linked
        groups.append(sorted(group))
    return groups


def _reduced(rows: torch.Tensor) -> torch.Tensor:
    """Reduced row echelon form of independent rows (r, m)."""
    rows = rows.clone()
    for i in range(len(rows)):
        relative = rows[i:].abs() / rows[i:].abs().amax(-1, keepdim=True)
        column = int((relative.amax(0) > 1e-6).nonzero()[0])
        best = i + int(rows[i:, column].abs().argmax())
        rows[[i, best]] = rows[[best, i]]
        rows[i] = rows[i] / rows[i, column].clone()
        for other in range(len(rows)):
            if other != i:
                rows[other] = rows[other] - rows[other, column].clone() * rows[i]
    return rows
