"""Gradients of readings for engines outside autograd, from forward-mode Jacobians in the backward pass."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.simulate.engine import Engine, expect_columns


def is_differentiated(theta: Tensor) -> bool:
    """Whether autograd records operations on these parameters."""
    return theta.requires_grad and torch.is_grad_enabled()


def readings_with_gradient(engine: Engine, theta: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch S C"]:
    """theta (*batch, P) -> readings y (*batch, S, C), with dL/dtheta = sum over S and C of dL/dy dy/dtheta.

    The Jacobian dy/dtheta (*batch, S, C, P) is computed together with the readings and stored for the backward pass, 8
    S C P bytes per lane in float64. Differentiating twice raises RuntimeError.
    """
    return _Readings.apply(theta, engine)


def expect_no_gradient(engine: Engine, theta: Tensor, what: str) -> None:
    """Raises ValueError if theta does not fit the engine or requires a gradient that this operation would lose."""
    expect_columns(engine, theta)
    if is_differentiated(theta):
        raise ValueError(
            f"{what}: expected theta without requires_grad on the {engine.name} engine, got one with it; differentiate "
            "readings(theta), take the reference engine, or pass theta.detach()"
        )


class _Readings(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, theta: Tensor, engine: Engine) -> Tensor:
        readings, jacobian = engine.linearise(theta.detach())
        ctx.save_for_backward(jacobian, theta)
        ctx.engine = engine.name
        return readings

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:
        jacobian, theta = ctx.saved_tensors
        slope = torch.einsum("...sc,...scp->...p", gradients[0], jacobian)
        return (_Once.apply(slope, theta, ctx.engine) if torch.is_grad_enabled() else slope), None


class _Once(torch.autograd.Function):
    """A gradient that cannot be differentiated again, because the engine has no second derivatives."""

    @staticmethod
    def forward(ctx: Any, slope: Tensor, theta: Tensor, engine: str) -> Tensor:
        ctx.engine = engine
        return slope.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None, None]:
        raise RuntimeError(
            f"expected a first derivative of the {ctx.engine} engine's readings, got a request for the second; take "
            "engine='reference', which torch differentiates any number of times"
        )
