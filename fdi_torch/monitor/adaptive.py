"""Parameters carried as states: the conventional adaptive observer (15) and the extended Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.monitor.gain import Gain, Linear, hand_gain, riccati
from fdi_torch.monitor.observer import bound
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import PlantState, Stepper, slopes
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale

FORGET = 1e-3  # share of a parameter's deviation that the design of (15) forgets in a sample
WANDER = 1e-6  # of a level in a sample, in units of the plant's length scale


@dataclass(frozen=True)
class Adapted:
    """levels (*batch, S, tanks), theta and std (*batch, S, P) after each sample, residual (*batch, S, sensors).

    std is NaN where the method has none.
    """

    levels: Tensor
    theta: Tensor
    std: Tensor
    residual: Tensor


class JointModel:
    """Levels and parameters as one state z = (x, theta); the parameters stand still."""

    def __init__(self, network: TankNetwork, space: ParameterSpace, longest_step: float | None = None) -> None:
        if network.command_memory() or network.reading_memory():
            raise ValueError("expected a plant without memory in actuators and sensors; leave such effects out")
        self.stepper, self.network, self.space = Stepper(network, longest_step), network, space
        self.tanks = len(network.description.tanks)

    def moved(self, z: Tensor, samples: Samples, k: int) -> Tensor:
        """From sample k to the next."""
        begin, end = float(samples.time[k]), float(samples.time[k + 1])
        values = bound(self.network, self.space, z[..., self.tanks :])
        state = PlantState(z[..., : self.tanks])
        after = self.stepper.advance(state, lambda share: samples.input_at(k, share), begin, end - begin, values)
        return torch.cat([after.levels, z[..., self.tanks :]], dim=-1)

    def read(self, z: Tensor, end: float) -> Tensor:
        values = bound(self.network, self.space, z[..., self.tanks :])
        return self.stepper.read(PlantState(z[..., : self.tanks]), end, 1.0, values)[0]

    def kept(self, z: Tensor) -> Tensor:
        """Levels not below zero, parameters within their ranges."""
        theta = z[..., self.tanks :]
        inside = torch.minimum(torch.maximum(theta, self.space.low(theta)), self.space.high(theta))
        return torch.cat([z[..., : self.tanks].clamp(min=0.0), inside], dim=-1)


def adaptive_observer(
    model: JointModel, samples: Samples, levels: Tensor, theta: Tensor, gain: Gain, rate: Tensor
) -> Adapted:
    """theta' = K_theta (y - y_hat) beside the Luenberger-like observer (2020 paper, eq. 15).

    levels (*batch, tanks) and theta (*batch, P) before the first sample; rate K_theta (P, sensors), parameter per
    reading and second. With more parameters than readings it settles on one of many explanations.
    """
    wanted = (len(model.space), len(model.network.description.sensors))
    if tuple(rate.shape) != wanted:
        raise ValueError(f"expected K_theta of {wanted[0]} parameters x {wanted[1]} sensors, got {tuple(rate.shape)}")
    z = torch.cat([levels, theta], dim=-1)
    states, residuals = [], []
    for k, end in enumerate(samples.time.tolist()):
        span = end - float(samples.time[k - 1]) if k else 0.0
        z = model.moved(z, samples, k - 1) if k else z
        residual = samples.readings[..., k, :] - model.read(z, end)
        both = torch.cat([gain.at(k), span * rate])
        z = model.kept(z + _times(both, torch.nan_to_num(residual, nan=0.0)))
        states.append(z)
        residuals.append(residual)
    path = torch.stack(states, dim=-2)
    found = path[..., model.tanks :]
    nothing = torch.full_like(found, torch.nan)
    return Adapted(path[..., : model.tanks], found, nothing, torch.stack(residuals, dim=-2))


def designed_rate(
    model: JointModel, samples: Samples, levels: Tensor, theta: Tensor, wander: Tensor, reading_std: Tensor
) -> tuple[Gain, Tensor]:
    """Gains of (15) about one operating point: L of the levels, and K_theta (P, sensors) per second.

    The steady joint Kalman gain for parameters that wander by `wander` (P,) a sample and forget a little, so that
    combinations which the readings do not determine there stay bounded. levels (tanks,), theta (P,).
    """
    z = torch.cat([levels, theta])
    transition = slopes(lambda x: model.moved(x, samples, 0), z)
    output = slopes(lambda x: model.read(x, float(samples.time[1])), z)
    keep = torch.ones_like(z)
    keep[model.tanks :] = 1.0 - FORGET
    levels_wander = WANDER * length_scale(model.network.description)
    process = torch.diag(torch.cat([torch.full_like(levels, levels_wander), wander]) ** 2)
    linear, reading = Linear(keep * transition, output), torch.diag(reading_std**2)
    predicted = riccati(linear, process, reading)
    gain = torch.linalg.solve(output @ predicted @ output.mT + reading, output @ predicted).mT
    span = float(samples.time[1] - samples.time[0])
    return hand_gain(gain[: model.tanks]), gain[model.tanks :] / span


def joint_filter(
    model: JointModel,
    samples: Samples,
    levels: Tensor,
    theta: Tensor,
    start_std: Tensor,
    wander: Tensor,
    reading_std: Tensor,
) -> Adapted:
    """Extended Kalman filter of levels and parameters (Jazwinski 1970, ch. 8), slopes by forward-mode differentiation.

    start_std and wander (tanks + P): how uncertain each is at the start, and how far it wanders in a sample.
    reading_std (*batch, sensors).
    """
    z = torch.cat([levels, theta], dim=-1)
    covariance = torch.diag(start_std**2).expand(*z.shape[:-1], -1, -1)
    states, stds, residuals = [], [], []
    for k, end in enumerate(samples.time.tolist()):
        if k:
            transition = slopes(lambda x, k=k: model.moved(x, samples, k - 1), z)  # type: ignore[misc]
            z = model.moved(z, samples, k - 1)
            covariance = _product(_product(transition, covariance), transition.mT) + torch.diag(wander**2)
        output = slopes(lambda x, end=end: model.read(x, end), z)  # type: ignore[misc]
        residual = samples.readings[..., k, :] - model.read(z, end)
        known = torch.isfinite(residual)
        output = torch.where(known.unsqueeze(-1), output, 0.0)
        across = _product(covariance, output.mT)
        spread = _product(output, across) + torch.diag_embed(reading_std**2)
        gain = torch.linalg.solve(spread, across.mT).mT
        z = model.kept(z + _times(gain, torch.where(known, residual, 0.0)))
        covariance = covariance - _product(gain, across.mT)
        covariance = 0.5 * (covariance + covariance.mT)
        states.append(z)
        stds.append(covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt())
        residuals.append(residual)
    path, std = torch.stack(states, dim=-2), torch.stack(stds, dim=-2)
    tanks = model.tanks
    return Adapted(path[..., :tanks], path[..., tanks:], std[..., tanks:], torch.stack(residuals, dim=-2))


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Explicit sums: a lane's result must not depend on how many lanes run beside it."""
    terms = [matrix[..., c] * vector[..., c : c + 1] for c in range(vector.shape[-1])]
    return torch.stack(terms).sum(0)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Batched matrix product by explicit sums."""
    terms = [a[..., :, c : c + 1] * b[..., c : c + 1, :] for c in range(b.shape[-2])]
    return torch.stack(torch.broadcast_tensors(*terms)).sum(0)
