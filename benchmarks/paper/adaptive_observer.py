"""Joint estimation of levels and parameters: the adaptive observer of the 2020 paper (eq. 15) and the EKF."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.monitor.observer import bind_parameters
from fdi_torch.monitor.observer_gain import Gain, Linear, hand_gain, riccati
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import PlantState, Stepper, slopes
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale

FORGETTING = 1e-3  # decay of a parameter's deviation per sample in the design of (15)
LEVEL_NOISE = 1e-6  # standard deviation of a level's process noise per sample, in units of the plant's length scale


@dataclass(frozen=True)
class AdaptiveRun:
    """Estimates after each sample: levels (*batch, S, tanks) m, theta and std (*batch, S, P), residual
    (*batch, S, sensors). std is NaN for the adaptive observer, which gives none.
    """

    levels: Tensor
    theta: Tensor
    std: Tensor
    residual: Tensor


class JointModel:
    """Levels and parameters as one state z = (x, theta) with constant parameters."""

    def __init__(self, network: TankNetwork, space: ParameterSpace) -> None:
        with_states = [p.prefix for p in network.placements if p.effect.memory or p.effect.states]
        if with_states:
            raise ValueError(
                f"expected effects without memory and states in joint estimation, got {', '.join(with_states)}; leave "
                "them out"
            )
        self.stepper, self.network, self.space = Stepper(network), network, space
        self.tanks = len(network.description.tanks)

    def moved(self, z: Tensor, samples: Samples, k: int) -> Tensor:
        """The state at sample k + 1 from that at sample k, with held inputs."""
        begin, end = float(samples.time[k]), float(samples.time[k + 1])
        values = bind_parameters(self.network, self.space, z[..., self.tanks :])
        state = PlantState(z[..., : self.tanks])
        after = self.stepper.advance(state, lambda share: samples.inputs[..., k, :], begin, end - begin, values)
        return torch.cat([after.levels, z[..., self.tanks :]], dim=-1)

    def read(self, z: Tensor, end: float) -> Tensor:
        values = bind_parameters(self.network, self.space, z[..., self.tanks :])
        return self.stepper.read(PlantState(z[..., : self.tanks]), end, 1.0, values)[0]

    def kept(self, z: Tensor) -> Tensor:
        """The state with levels limited to zero or more and parameters to their ranges."""
        theta = z[..., self.tanks :]
        inside = torch.minimum(torch.maximum(theta, self.space.low(theta)), self.space.high(theta))
        return torch.cat([z[..., : self.tanks].clamp(min=0.0), inside], dim=-1)


def adaptive_observer(
    model: JointModel, samples: Samples, levels: Tensor, theta: Tensor, gain: Gain, rate: Tensor
) -> AdaptiveRun:
    """Luenberger-like observer extended by theta' = K_theta (y - y_hat) (2020 paper, eq. 15).

    levels (*batch, tanks) and theta (*batch, P) before the first sample; rate: K_theta (P, sensors), parameter per
    reading and second. With more parameters than readings the result is one of many explanations.
    """
    shape = (len(model.space), len(model.network.description.sensors))
    if tuple(rate.shape) != shape:
        raise ValueError(f"expected K_theta of {shape[0]} parameters x {shape[1]} sensors, got {tuple(rate.shape)}")
    z = torch.cat([levels, theta], dim=-1)
    states, residuals = [], []
    for k, end in enumerate(samples.time.tolist()):
        span = end - float(samples.time[k - 1]) if k else 0.0
        z = model.moved(z, samples, k - 1) if k else z
        residual = samples.readings[..., k, :] - model.read(z, end)
        both = torch.cat([gain.table(k, 1)[0], span * rate])
        z = model.kept(z + _times(both, torch.nan_to_num(residual, nan=0.0)))
        states.append(z)
        residuals.append(residual)
    path = torch.stack(states, dim=-2)
    parameters = path[..., model.tanks :]
    no_std = torch.full_like(parameters, torch.nan)
    return AdaptiveRun(path[..., : model.tanks], parameters, no_std, torch.stack(residuals, dim=-2))


def adaptive_gain(
    model: JointModel, samples: Samples, levels: Tensor, theta: Tensor, wander: Tensor, reading_std: Tensor
) -> tuple[Gain, Tensor]:
    """Gains of (15) about one operating point: L of the levels, and K_theta (P, sensors) per second.

    They are the steady joint Kalman gain for parameters with process noise `wander` (P,) per sample. A small forgetting
    factor keeps parameter combinations bounded that the readings do not determine. levels (tanks,), theta (P,).
    """
    z = torch.cat([levels, theta])
    transition = slopes(lambda x: model.moved(x, samples, 0), z)
    output = slopes(lambda x: model.read(x, float(samples.time[1])), z)
    keep = torch.ones_like(z)
    keep[model.tanks :] = 1.0 - FORGETTING
    level_std = LEVEL_NOISE * length_scale(model.network.description)
    process = torch.diag(torch.cat([torch.full_like(levels, level_std), wander]) ** 2)
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
) -> AdaptiveRun:
    """Extended Kalman filter of levels and parameters (Jazwinski 1970, ch. 8), Jacobians by forward-mode
    differentiation.

    start_std and wander (tanks + P): standard deviations of the initial state and of the process noise per sample.
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
        present = torch.isfinite(residual)
        output = torch.where(present.unsqueeze(-1), output, 0.0)
        cross_covariance = _product(covariance, output.mT)
        residual_covariance = _product(output, cross_covariance) + torch.diag_embed(reading_std**2)
        gain = torch.linalg.solve(residual_covariance, cross_covariance.mT).mT
        z = model.kept(z + _times(gain, torch.where(present, residual, 0.0)))
        covariance = covariance - _product(gain, cross_covariance.mT)
        covariance = 0.5 * (covariance + covariance.mT)
        states.append(z)
        stds.append(covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt())
        residuals.append(residual)
    path, std = torch.stack(states, dim=-2), torch.stack(stds, dim=-2)
    tanks = model.tanks
    return AdaptiveRun(path[..., :tanks], path[..., tanks:], std[..., tanks:], torch.stack(residuals, dim=-2))


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrix times vector by explicit sums, so that a batch member does not depend on the batch size."""
    terms = [matrix[..., c] * vector[..., c : c + 1] for c in range(vector.shape[-1])]
    return torch.stack(terms).sum(0)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Batched matrix product by explicit sums."""
    terms = [a[..., :, c : c + 1] * b[..., c : c + 1, :] for c in range(b.shape[-2])]
    return torch.stack(torch.broadcast_tensors(*terms)).sum(0)
