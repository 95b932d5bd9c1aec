"""How sure an estimate can be: Fisher information, covariance, the directions that nothing determines, and ellipses.

Everything is done in units in which each parameter's information is one, so that parameters of very different size and
unit neither hide nor fake a direction that is not determined.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.batch_algebra import row_sum

# Below this share of the largest eigenvalue of the scaled information, a direction counts as undetermined.
RELATIVE_EIGENVALUE = 1e-10
# A parameter belongs to an undetermined direction if its share of it, squared, exceeds this.
_SHARE = 1e-6


def fisher_information(jacobian: Tensor, noise_std: Tensor, weight: Tensor | None = None) -> Tensor:
    """sum over samples and channels of J J' / sigma^2 for independent Gaussian noise, (*batch, P, P).

    jacobian (*batch, S, C, P) of the readings; noise_std (*batch, C), in their unit; weight (*batch, S, C), 0 masks.
    """
    scaled = jacobian / noise_std[..., None, :, None]
    if weight is not None:
        scaled = scaled * weight[..., None].sqrt()
    rows = scaled.flatten(-3, -2)
    return rows.mT @ rows


@dataclass(frozen=True)
class Certainty:
    """What an information matrix says.

    std (*batch, P): standard errors, infinite for a parameter that is part of an undetermined direction.
    covariance (*batch, P, P): of such a parameter infinite on the diagonal and NaN beside it.
    null (*batch, P, P): projector on the undetermined directions, in the scaled parameters; 0 where there is none.
    scale (*batch, P): parameter = scale * scaled parameter.
    """

    std: Tensor
    covariance: Tensor
    null: Tensor
    scale: Tensor


def certainty(information: Tensor, held: Tensor | None = None, threshold: float = RELATIVE_EIGENVALUE) -> Certainty:
    """Covariance from the Fisher information (*batch, P, P), priors included: the Cramer-Rao bound at the estimate.

    held (*batch, P) bool: parameters known exactly, such as those that a bound keeps in place; their standard error is
    0 and they add nothing to that of the others.
    """
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(diagonal > 0, 1.0 / torch.where(diagonal > 0, diagonal, 1.0).sqrt(), 1.0)
    scaled = information * scale[..., :, None] * scale[..., None, :]
    scaled = 0.5 * (scaled + scaled.mT)
    if held is not None:
        # Information of their own, unconnected with the others; what it leads to is replaced by zeros below.
        apart = held[..., :, None] | held[..., None, :]
        scaled = torch.where(apart, torch.eye(scaled.shape[-1]).to(scaled), scaled)
    broken = ~torch.isfinite(scaled).all(-1).all(-1)[..., None, None]
    values, vectors = _eigen(torch.where(broken, torch.zeros_like(scaled), scaled))
    lost = (values <= threshold * values[..., -1:].clamp(min=0.0)) | (values <= 0)
    inverse = torch.where(lost, 0.0, 1.0 / torch.where(lost, 1.0, values))
    null = _composed(vectors, lost.to(vectors))
    covariance = _composed(vectors, inverse) * scale[..., :, None] * scale[..., None, :]
    return _marked(covariance, null, scale, held)


def _eigen(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues (*batch, P) in ascending order and eigenvectors (*batch, P, P) of symmetric matrices.

    One at a time, each in memory of its own: the library's last bit depends on where in memory a matrix begins.
    """
    parameters = matrix.shape[-1]
    pairs = [torch.linalg.eigh(one.clone()) for one in matrix.reshape(-1, parameters, parameters)]
    values, vectors = (torch.stack(parts) for parts in zip(*pairs, strict=True))
    return values.reshape(matrix.shape[:-1]), vectors.reshape(matrix.shape)


def _composed(vectors: Tensor, values: Tensor) -> Tensor:
    """V diag(values) V', (*batch, P, P), summed in an order that does not depend on the batch."""
    return row_sum(vectors[..., :, None, :] * vectors[..., None, :, :] * values[..., None, None, :])


def _marked(covariance: Tensor, null: Tensor, scale: Tensor, held: Tensor | None) -> Certainty:
    """Infinite where undetermined, zero where held."""
    open_ = null.diagonal(dim1=-2, dim2=-1) > _SHARE
    beside = open_[..., :, None] | open_[..., None, :]
    covariance = torch.where(beside, math.nan, covariance)
    covariance = torch.where(torch.diag_embed(open_), math.inf, covariance)
    if held is not None:
        covariance = torch.where(held[..., :, None] | held[..., None, :], 0.0, covariance)
    return Certainty(covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt(), covariance, null, scale)


def cramer_rao(information: Tensor, threshold: float = RELATIVE_EIGENVALUE) -> Tensor:
    """The smallest standard deviation (*batch, P) that an unbiased estimator can have; infinite where undetermined."""
    return certainty(information, threshold=threshold).std


def determined_combinations(null: Tensor, scale: Tensor) -> list[tuple[list[int], Tensor]]:
    """Groups of parameters that are undetermined together, with the combinations of them that are determined.

    null, scale (P, P), (P,) of one `Certainty`. For each group: its m parameters and coefficients (m - k, m) of the
    combinations, k being the undetermined directions among them, reduced so that each begins with a 1 of its own.
    """
    groups = []
    for members in _groups(null):
        block = null[members][:, members]
        values, vectors = torch.linalg.eigh(block)
        kept = vectors[:, values < 0.5].mT / scale[members]
        groups.append((members, _reduced(kept)))
    return groups


def _groups(null: Tensor) -> list[list[int]]:
    """Parameters linked by a common undetermined direction."""
    left = [i for i in range(len(null)) if null[i, i] > _SHARE]
    groups = []
    while left:
        group = [left.pop(0)]
        for member in group:
            linked = [j for j in left if abs(float(null[member, j])) > math.sqrt(_SHARE) * 0.1]
            left = [j for j in left if j not in linked]
            group += linked
        groups.append(sorted(group))
    return groups


def _reduced(rows: Tensor) -> Tensor:
    """Reduced row echelon form of independent rows (r, m)."""
    rows = rows.clone()
    for i in range(len(rows)):
        free = rows[i:].abs() / rows[i:].abs().amax(-1, keepdim=True)
        column = int((free.amax(0) > 1e-6).nonzero()[0])
        best = i + int(rows[i:, column].abs().argmax())
        rows[[i, best]] = rows[[best, i]]
        rows[i] = rows[i] / rows[i, column].clone()
        for other in range(len(rows)):
            if other != i:
                rows[other] = rows[other] - rows[other, column].clone() * rows[i]
    return rows
