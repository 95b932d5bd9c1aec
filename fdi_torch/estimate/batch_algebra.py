"""Linear algebra of small vectors and matrices with results that are bit-for-bit independent of the batch size.

All functions use elementwise operations in a fixed order, because library products and factorisations choose their
order of summation by the shape of the whole batch.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float


def row_sum(values: Float[torch.Tensor, "*batch N"]) -> Float[torch.Tensor, "*batch"]:
    """Pairwise sum over the last dimension, in an order that depends only on N."""
    count, sums = values.shape[-1], values.clone()
    if count == 0:
        return values.new_zeros(values.shape[:-1])
    while count > 1:
        half = (count + 1) // 2
        sums[..., : count - half] += sums[..., half:count]
        count = half
    return sums[..., 0]


def dot(a: Float[torch.Tensor, "*batch P"], b: Float[torch.Tensor, "*batch P"]) -> Float[torch.Tensor, "*batch"]:
    """Inner product of vectors."""
    return row_sum(a * b)


def apply(
    matrix: Float[torch.Tensor, "*#batch M P"], vector: Float[torch.Tensor, "*#batch P"]
) -> Float[torch.Tensor, "*#batch M"]:
    """Matrix times vector."""
    return row_sum(matrix * vector[..., None, :])


def solve_positive(
    matrix: Float[torch.Tensor, "*batch P P"], right: Float[torch.Tensor, "*batch P"]
) -> tuple[Float[torch.Tensor, "*batch P"], Bool[torch.Tensor, "*batch"]]:
    """Solve matrix x = right for positive definite matrices, by Gauss-Jordan.

    There is no pivoting, which positive definite matrices of unit diagonal do not need. Also returns whether each
    matrix is positive definite; if it is not, x is meaningless.
    """
    rows = torch.cat((matrix, right[..., None]), -1)
    is_positive = torch.ones(rows.shape[:-2], dtype=torch.bool, device=rows.device)
    for j in range(right.shape[-1]):
        pivot = rows[..., j, j]
        is_positive = is_positive & (pivot > 0)
        row = rows[..., j, :] / torch.where(pivot > 0, pivot, 1.0)[..., None]
        rows = rows - rows[..., :, j, None] * row[..., None, :]
        rows[..., j, :] = row
    return rows[..., -1], is_positive
