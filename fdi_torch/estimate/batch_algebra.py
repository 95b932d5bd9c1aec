"""Linear algebra of small vectors whose last bit does not depend on the batch: elementwise operations in a fixed order.

Library products and factorisations choose their order of summation by the shape of the whole batch.
"""

from __future__ import annotations

import torch
from torch import Tensor


def row_sum(values: Tensor) -> Tensor:
    """Sum over the last dimension in an order that depends on its length alone: (..., N) -> (...)."""
    if values.shape[-1] == 0:
        return values.new_zeros(values.shape[:-1])
    while values.shape[-1] > 1:
        half = (values.shape[-1] + 1) // 2
        rest = torch.nn.functional.pad(values[..., half:], (0, 2 * half - values.shape[-1]))
        values = values[..., :half] + rest
    return values[..., 0]


def dot(a: Tensor, b: Tensor) -> Tensor:
    """(..., P), (..., P) -> (...)."""
    return row_sum(a * b)


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrix times vector, (..., M, P), (..., P) -> (..., M)."""
    return row_sum(matrix * vector[..., None, :])


def solve_positive(matrix: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """x of matrix x = right, (..., P, P), (..., P) -> (..., P), for positive definite matrices, by Gauss-Jordan.

    Without pivoting, which positive definite matrices of unit diagonal do not need. Also returns (...), whether the
    matrix turned out to be positive definite; where it did not, x means nothing.
    """
    rows = torch.cat((matrix, right[..., None]), -1)
    positive = torch.ones(rows.shape[:-2], dtype=torch.bool, device=rows.device)
    for j in range(right.shape[-1]):
        pivot = rows[..., j, j]
        positive = positive & (pivot > 0)
        row = rows[..., j, :] / torch.where(pivot > 0, pivot, 1.0)[..., None]
        rows = rows - rows[..., :, j, None] * row[..., None, :]
        rows[..., j, :] = row
    return rows[..., -1], positive
