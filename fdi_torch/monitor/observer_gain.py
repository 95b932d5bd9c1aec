"""Gain of a Luenberger-like observer: the Kalman gain of the linearised plant."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.monitor.stepper import Stepper, slopes
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.network import PlaceValues
from fdi_torch.plant.scales import length_scale
from fdi_torch.simulate.forward_mode import constants_with_slopes, with_slope

DOUBLINGS = 60
LONGEST_TRANSIENT = 2000  # samples until the gain must be steady
# Standard deviation of an initial level known from the first reading only, as a share of the tank's height.
START_SHARE = 1.0


@dataclass(frozen=True)
class Gain:
    """Observer gain at every sample, m per unit of the reading.

    steady (*batch, order, sensors), for each state of the network. opening (K, *batch, order, sensors): larger gains of
    the first K samples, while the initial levels are uncertain. inflation (K, *batch, sensors): standard deviation of
    the residuals during these samples over the steady one.
    """

    steady: Tensor
    opening: Tensor
    inflation: Tensor

    def table(self, first: int, count: int) -> Tensor:
        """Gains of `count` samples, of which the first has the number `first`: (count, *batch, tanks, sensors)."""
        opening = self.opening[first : first + count]
        return torch.cat([opening, self.steady.expand(count - len(opening), *self.steady.shape)])

    def spread(self, first: int, count: int) -> Tensor:
        """Inflation (*batch, count, sensors) of the same samples; 1 after the first K samples of a run."""
        opening = self.inflation[first : first + count]
        steady = torch.ones_like(self.steady[..., 0, :]).expand(count - len(opening), *self.steady[..., 0, :].shape)
        return torch.cat([opening, steady]).movedim(0, -2)


@dataclass(frozen=True)
class Linear:
    """Plant over one sampling interval: transition (*batch, order, order), output (*batch, sensors, order)."""

    transition: Tensor
    output: Tensor


def linearised(stepper: Stepper, levels: Tensor, inputs: Tensor, span: float, values: PlaceValues) -> Linear:
    """The plant linearised about levels (*batch, tanks), effects steady, inputs (*batch, channels) held `span` s."""

    def moved(x: Tensor) -> Tensor:
        held, given = with_slope(inputs), constants_with_slopes(values)
        return stepper.advance(stepper.start(x, held, given), lambda share: held, 0.0, span, given).levels

    def read(x: Tensor) -> Tensor:
        given = constants_with_slopes(values)
        return stepper.read(stepper.start(x, with_slope(inputs), given), span, span, given)[0]

    state = stepper.start(levels, inputs, values).levels
    return Linear(slopes(moved, state), slopes(read, state))


def kalman_gain(linear: Linear, process_std: Tensor, reading_std: Tensor, start_std: Tensor) -> Gain:
    """Kalman gain with its initial transient.

    process_std (*batch, tanks) m per sample, reading_std (*batch, sensors) and start_std (tanks) m: standard deviations
    of process noise, readings and initial levels; only their ratios matter. The states of effects have no noise of
    their own, and are in steady state at first. The steady gain solves the discrete
    algebraic Riccati equation. Raises ValueError if a level is not observable.
    """
    order = linear.transition.shape[-1]
    process_std, start_std = with_effects(process_std, order), with_effects(start_std, order)
    process, reading = torch.diag_embed(process_std**2), torch.diag_embed(reading_std**2)
    steady = riccati(linear, process, reading)
    final, final_std = _filter_gain(linear, steady, reading)
    gains, stds = [], []
    batch = final.shape[:-2]
    predicted = torch.diag_embed(start_std.expand(*batch, linear.transition.shape[-1]) ** 2)
    for _ in range(LONGEST_TRANSIENT):
        gain, std = _filter_gain(linear, predicted, reading)
        if bool((((gain - final).abs() <= 1e-3 * final.abs().amax()) & torch.isfinite(gain)).all()):
            break
        gains.append(gain)
        stds.append(std / final_std)
        corrected = predicted - gain @ linear.output @ predicted
        predicted = linear.transition @ corrected @ linear.transition.mT + process
    opening = torch.stack(gains) if gains else final.new_zeros(0, *final.shape)
    inflation = torch.stack(stds) if stds else final_std.new_zeros(0, *final_std.shape)
    return Gain(final, opening, inflation)


def with_effects(std: Tensor, order: int) -> Tensor:
    """Standard deviations (*batch, tanks) of levels -> (*batch, order), 0 for the states of effects."""
    return torch.cat([std, std.new_zeros(*std.shape[:-1], order - std.shape[-1])], dim=-1)


def riccati(linear: Linear, process: Tensor, reading: Tensor) -> Tensor:
    """Steady covariance of the predicted levels, P = F (P - P H' (H P H' + R)^-1 H P) F' + Q.

    Structure-preserving doubling (Chu, Fan, Lin & Wang 2004), which converges quadratically.
    """
    eye = torch.eye(linear.transition.shape[-1], dtype=process.dtype, device=process.device)
    a = linear.transition.mT
    g = linear.output.mT @ torch.linalg.solve(
        reading, linear.output.expand(*reading.shape[:-2], *linear.output.shape[-2:])
    )
    h = process
    for _ in range(DOUBLINGS):
        inverse = torch.linalg.inv(eye + g @ h)
        change = a.mT @ h @ inverse @ a
        a, g, h = a @ inverse @ a, g + a @ inverse @ g @ a.mT, h + change
        if bool((change.abs() <= 1e-13 * h.abs().amax()).all()):
            return 0.5 * (h + h.mT)
    raise ValueError(
        "expected a plant whose levels can all be observed from its sensors, got one with an unobserved level that is "
        "not stable by itself; add a sensor"
    )


def hand_gain(matrix: Tensor) -> Gain:
    """A constant gain (order, sensors): K_obv of eq. 14 times the sampling interval."""
    return Gain(matrix, matrix.new_zeros(0, *matrix.shape), matrix.new_zeros(0, matrix.shape[-1]))


def start_uncertainty(plant: PlantDescription, like: Tensor) -> Tensor:
    """Standard deviation (tanks,) m of initial levels that are known from the first reading only."""
    return like.new_tensor([START_SHARE * tank.height for tank in plant.tanks])


def start_beside_noise(plant: PlantDescription, like: Tensor) -> Tensor:
    """Standard deviation (tanks,) of initial levels relative to unknown reading noise.

    About one, because the first reading has that noise too; it is larger for taller tanks, in units of the plant's
    length scale.
    """
    return start_uncertainty(plant, like) / length_scale(plant)


def _filter_gain(linear: Linear, predicted: Tensor, reading: Tensor) -> tuple[Tensor, Tensor]:
    """L = P H' (H P H' + R)^-1, and the standard deviation of the residuals (*batch, sensors)."""
    covariance = linear.output @ predicted @ linear.output.mT + reading
    gain = torch.linalg.solve(covariance, linear.output @ predicted).mT
    return gain, torch.sqrt(torch.diagonal(covariance, dim1=-2, dim2=-1))
