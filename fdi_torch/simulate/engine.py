"""The interface of all engines: readings, their Jacobian, and sums over samples that need no stored trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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

    why: the reason for the choice of this engine, one sentence.
    """

    name: str
    why: str
    network: TankNetwork
    space: ParameterSpace
    experiment: Experiment

    def __repr__(self) -> str:
        sensors, samples = len(self.network.description.sensors), len(self.experiment.sample_times)
        reason = f" ({self.why})" if self.why else ""
        return (
            f"{self.name} engine: {self.network.description.name}, {sensors} sensors, {samples} samples, "
            f"{self.experiment.steps_text}{reason}; columns of theta: {', '.join(self.space.names)}"
        )

    def readings(self, theta: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch S C"]:
        """Readings in SI; differentiable if theta requires a gradient."""
        raise NotImplementedError

    def levels(self, theta: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch S tanks"]:
        """Tank levels at the samples, m."""
        raise NotImplementedError

    def linearise(
        self, theta: Float[Tensor, "*batch P"]
    ) -> tuple[Float[Tensor, "*batch S C"], Float[Tensor, "*batch S C P"]]:
        """Readings and their Jacobian, by forward mode."""
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
