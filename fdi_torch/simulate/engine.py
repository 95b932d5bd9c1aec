"""The interface of all engines: readings, their gradient and Jacobian, and sums over samples that need no stored
trajectory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.experiment import Experiment


@dataclass(frozen=True)
class Readings:
    """Measured readings, to be compared with an engine's predictions.

    values and weight: (S, C) for all lanes, or (problems, S, C), one set per problem. A value of weight n is the
    mean of n readings; weight 0 masks it.
    """

    values: Tensor
    weight: Tensor

    def __post_init__(self) -> None:
        if self.values.dim() < 2 or self.weight.shape != self.values.shape:
            raise ValueError(
                f"expected values and weights of one shape (*problems, samples, channels), got "
                f"{tuple(self.values.shape)} and {tuple(self.weight.shape)}"
            )

    @cached_property
    def count(self) -> Tensor:
        """The number of unmasked readings, (C,) or (problems, C)."""
        return self.weight.sum(dim=-2)

    @cached_property
    def degrees(self) -> Tensor:
        """The number of unmasked values, (C,) or (problems, C)."""
        return (self.weight > 0).sum(dim=-2).to(self.weight.dtype)

    @cached_property
    def known(self) -> Tensor:
        """The values, 0 where masked."""
        return torch.where(self.weight > 0, self.values, 0.0)

    @cached_property
    def centre(self) -> Tensor:
        """Weighted means, (C,) or (problems, C); 0 for a channel without readings."""
        return (self.known * self.weight).sum(dim=-2) / torch.where(self.count > 0, self.count, 1.0)

    def of(self, lanes: Tensor) -> Readings:
        """The readings of the selected problems; readings shared by all are returned unchanged."""
        return self if self.values.dim() == 2 else Readings(self.values[lanes], self.weight[lanes])


class Engine:
    """A plant in one experiment, simulated for many parameter vectors (lanes) at once. C sensors, S samples, P
    parameters.

    why: the reason for the choice of this engine, one sentence. own_steps: whether each lane can divide the steps of
    the grid (`Experiment.step_control`). An engine implements `_simulate`, or `readings`, `levels` and `linearise`.
    """

    name: ClassVar[str]
    own_steps: ClassVar[bool] = False

    def __init__(self, network: TankNetwork, space: ParameterSpace, experiment: Experiment, why: str = "") -> None:
        if experiment.step_control is not None and not self.own_steps:
            raise ValueError(f"expected the same steps for all lanes in the {self.name} engine, got adaptive steps")
        self.network, self.space, self.experiment, self.why = network, space, experiment, why

    def __repr__(self) -> str:
        sensors, samples = len(self.network.description.sensors), len(self.experiment.sample_times)
        reason = f" ({self.why})" if self.why else ""
        return (
            f"{self.name} engine: {self.network.description.name}, {sensors} sensors, {samples} samples, "
            f"{self.experiment.steps_text}{reason}; columns of theta: {', '.join(self.space.names)}"
        )

    def readings(self, theta: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch S C"]:
        """Readings in SI; differentiable if theta requires a gradient.

        With dL/dtheta = sum over S and C of dL/dy dy/dtheta: the Jacobian is computed together with the readings and
        stored for the backward pass, 8 S C P bytes per lane in float64. Differentiating twice raises RuntimeError.
        """
        expect_columns(self, theta)
        return _Readings.apply(theta, self) if _is_differentiated(theta) else self._simulate("readings", theta)[0]

    def levels(self, theta: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch S tanks"]:
        """Tank levels at the samples, m."""
        expect_no_gradient(self, theta, "levels")
        return self._simulate("levels", theta)[0]

    def linearise(
        self, theta: Float[Tensor, "*batch P"]
    ) -> tuple[Float[Tensor, "*batch S C"], Float[Tensor, "*batch S C P"]]:
        """Readings and their Jacobian, by forward mode."""
        expect_no_gradient(self, theta, "linearise")
        readings, jacobian = self._simulate("linearise", theta)
        assert jacobian is not None
        return readings, jacobian

    def _simulate(self, mode: str, theta: Tensor) -> tuple[Tensor, Tensor | None]:
        """Levels or readings, and the Jacobian in the mode 'linearise'."""
        raise NotImplementedError

    def moments(self, theta: Float[Tensor, "*problems N P"], data: Readings) -> Float[Tensor, "*problems N C 3"]:
        """Weighted sums of r, r^2 and r y' over the samples.

        r = y - prediction, y' = y - mean(y). Likelihood and correlation follow from them and the sums of y.
        """
        expect_problems(theta, data)
        return moments_of(self.readings(theta), data)

    def gram(self, theta: Float[Tensor, "*problems N P"], data: Readings) -> Float[Tensor, "*problems N C W W"]:
        """Weighted sums of the products of [d prediction/d theta, r, y', 1]; W = P + 3."""
        expect_problems(theta, data)
        readings, jacobian = self.linearise(theta)
        return gram_of(readings, jacobian, data)


def expect_columns(engine: Engine, theta: object) -> None:
    """Raises ValueError unless theta is a floating-point tensor (*batch, P) with the columns of the engine's space."""
    names = engine.space.names
    if isinstance(theta, Tensor):
        if theta.is_floating_point() and theta.shape[-1:] == (len(names),):
            return
        got = f"{theta.dtype} of shape {tuple(theta.shape)}"
    else:
        got = type(theta).__name__
    columns = f"the {len(names)} columns {', '.join(map(str, names))}" if len(names) > 1 else f"the column {names[0]}"
    example = f"[[{', '.join(['0.1'] * len(names))}]]" if len(names) < 5 else "rows"
    dtype = theta.dtype if isinstance(theta, Tensor) and theta.is_floating_point() else torch.float64
    raise ValueError(
        f"theta: expected a tensor of floating-point numbers with {columns}, got {got}; "
        f"write torch.tensor({example}, dtype={dtype})"
    )


def _is_differentiated(theta: Tensor) -> bool:
    """Whether autograd records operations on these parameters."""
    return theta.requires_grad and torch.is_grad_enabled()


def expect_no_gradient(engine: Engine, theta: Tensor, what: str) -> None:
    """Raises ValueError if theta does not fit the engine or requires a gradient that this operation would lose."""
    expect_columns(engine, theta)
    if _is_differentiated(theta):
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


def expect_problems(theta: Float[Tensor, "*problems N P"], data: Readings) -> None:
    """Raises ValueError if theta (*problems, N, P) and the data have different problem dimensions."""
    problems = data.values.shape[:-2]
    if problems and theta.shape[:-2] != problems:
        raise ValueError(
            f"expected theta of shape (*problems, N, P) with problems {tuple(problems)} as in the data, "
            f"got {tuple(theta.shape)}"
        )


def moments_of(readings: Float[Tensor, "*problems N S C"], data: Readings) -> Float[Tensor, "*problems N C 3"]:
    """`Engine.moments` from readings (*problems, N, S, sensors)."""
    y, w = data.known.unsqueeze(-3), data.weight.unsqueeze(-3)
    residual = y - readings
    columns = (torch.ones_like(residual), residual, y - data.centre.unsqueeze(-2).unsqueeze(-3))
    return torch.stack([(w * residual * c).sum(-2) for c in columns], dim=-1)


def gram_of(
    readings: Float[Tensor, "*problems N S C"], jacobian: Float[Tensor, "*problems N S C P"], data: Readings
) -> Float[Tensor, "*problems N C W W"]:
    """`Engine.gram` from readings (*problems, N, S, sensors) and their Jacobian (..., P)."""
    y, w = data.known.unsqueeze(-3), data.weight.unsqueeze(-3).expand(readings.shape)
    residual = y - readings
    centred = (y - data.centre.unsqueeze(-2).unsqueeze(-3)).expand(residual.shape)
    others = torch.stack([residual, centred, torch.ones_like(residual)], dim=-1)
    columns = torch.cat([jacobian, others], dim=-1)
    columns = torch.where(w.unsqueeze(-1) > 0, columns, 0.0).movedim(-2, -3)
    return (columns * w.movedim(-1, -2).unsqueeze(-1)).mT @ columns
