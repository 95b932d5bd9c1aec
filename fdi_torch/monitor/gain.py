"""Gains of a Luenberger-like observer: Kalman's from noise levels, one for a wished time constant, or one by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.monitor.stepper import Stepper, slopes
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.network import PlaceValues
from fdi_torch.plant.scales import length_scale

DOUBLINGS = 60
OPENING = 2000  # samples at most until the gain has settled
# How far a start level may be off when nothing but the first reading tells, as a share of the tank's height.
START_SHARE = 1.0


@dataclass(frozen=True)
class Gain:
    """How far each reading's error moves each level, m per unit of the reading, at every sample.

    steady (*batch, tanks, sensors). opening (K, *batch, tanks, sensors): the larger gains of the first K samples, while
    the start levels are uncertain. inflation (K, *batch, sensors): the residuals' standard deviation there, as a
    multiple of the steady one.
    """

    steady: Tensor
    opening: Tensor
    inflation: Tensor

    def at(self, k: int) -> Tensor:
        return self.opening[k] if k < len(self.opening) else self.steady

    def table(self, first: int, count: int) -> Tensor:
        """The gains of `count` samples from the `first` of a run on, (count, *batch, tanks, sensors)."""
        opening = self.opening[first : first + count]
        return torch.cat([opening, self.steady.expand(count - len(opening), *self.steady.shape)])

    def spread(self, first: int, count: int) -> Tensor:
        """The inflation at `count` samples from the `first` of a run on, (*batch, count, sensors)."""
        opening = self.inflation[first : first + count]
        rest = torch.ones_like(self.steady[..., 0, :]).expand(count - len(opening), *self.steady[..., 0, :].shape)
        return torch.cat([opening, rest]).movedim(0, -2)


@dataclass(frozen=True)
class Linear:
    """A plant over one sampling interval: transition (*batch, tanks, tanks) and output (*batch, sensors, tanks)."""

    transition: Tensor
    output: Tensor


def linearised(stepper: Stepper, levels: Tensor, inputs: Tensor, span: float, values: PlaceValues) -> Linear:
    """The plant's slopes about levels (*batch, tanks) under inputs (*batch, channels) held for `span` s."""

    def moved(x: Tensor) -> Tensor:
        return stepper.advance(stepper.start(x, inputs, values), lambda share: inputs, 0.0, span, values).levels

    def read(x: Tensor) -> Tensor:
        return stepper.read(stepper.start(x, inputs, values), span, span, values)[0]

    return Linear(slopes(moved, levels), slopes(read, levels))


def kalman_gain(linear: Linear, process_std: Tensor, reading_std: Tensor, start_std: Tensor) -> Gain:
    """The gain of least error for levels that wander by process_std (*batch, tanks) m a sample, readings that err by
    reading_std (*batch, sensors), and a start that is known to start_std (tanks) m. All in units of the noise where
    that is unknown: only their ratios count.

    Steady: the discrete algebraic Riccati equation. Raises ValueError where an unmeasured level cannot be observed.
    """
    process, reading = torch.diag_embed(process_std**2), torch.diag_embed(reading_std**2)
    steady = riccati(linear, process, reading)
    final, settled = _filter_gain(linear, steady, reading)
    gains, spreads = [], []
    batch = final.shape[:-2]
    predicted = torch.diag_embed(start_std.expand(*batch, linear.transition.shape[-1]) ** 2)
    for _ in range(OPENING):
        gain, spread = _filter_gain(linear, predicted, reading)
        if bool((((gain - final).abs() <= 1e-3 * final.abs().amax()) & torch.isfinite(gain)).all()):
            break
        gains.append(gain)
        spreads.append(spread / settled)
        kept = predicted - gain @ linear.output @ predicted
        predicted = linear.transition @ kept @ linear.transition.mT + process
    opening = torch.stack(gains) if gains else final.new_zeros(0, *final.shape)
    inflation = torch.stack(spreads) if spreads else settled.new_zeros(0, *settled.shape)
    return Gain(final, opening, inflation)


def riccati(linear: Linear, process: Tensor, reading: Tensor) -> Tensor:
    """Steady covariance of the predicted levels, P = F (P - P H' (H P H' + R)^-1 H P) F' + Q.

    By structure-preserving doubling (Chu, Fan, Lin & Wang 2004), which squares the error each time.
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
        "expected a plant whose levels can all be observed from its sensors, got one with an unseen level that does "
        "not settle by itself; add a sensor or give the gain by hand"
    )


def hand_gain(matrix: Tensor) -> Gain:
    """A gain as given, (tanks, sensors), the same at every sample. K_obv of (14) times the sampling interval."""
    return Gain(matrix, matrix.new_zeros(0, *matrix.shape), matrix.new_zeros(0, matrix.shape[-1]))


def timed_gain(linear: Linear, span: float, time_constant: float, reading_std: Tensor, start_std: Tensor) -> Gain:
    """The Kalman gain whose slowest error decays with `time_constant` s, found by bisection over the wander.

    span: s between samples. reading_std (sensors,) and start_std (tanks,) as in `kalman_gain`: their ratios count.
    Raises ValueError where no gain is that fast, because a level is not measured, or that slow.
    """
    if not time_constant > 0:
        raise ValueError(f"expected a positive time constant of the observer, got {time_constant} s")
    wanted = math.exp(-span / time_constant)
    scale = float(reading_std.max())
    process = torch.ones_like(start_std)

    def at(exponent: float) -> Gain:
        return kalman_gain(linear, process * scale * 10.0**exponent, reading_std, start_std)

    low, high = -6.0, 4.0
    slowest, fastest = _radius(linear, at(low).steady), _radius(linear, at(high).steady)
    if not fastest <= wanted <= slowest:
        raise ValueError(
            f"expected a time constant between {-span / math.log(max(fastest, 1e-300)):.3g} s and "
            f"{-span / math.log(slowest):.3g} s, which this plant and its sensors allow, got {time_constant:g} s"
        )
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _radius(linear, at(middle).steady) > wanted else (low, middle)
    return at(0.5 * (low + high))


def spectral_radius(linear: Linear, gain: Tensor) -> Tensor:
    """Of the error's transition F (I - L H), (*batch). Below 1 the error decays."""
    eye = torch.eye(linear.transition.shape[-1], dtype=gain.dtype, device=gain.device)
    return torch.linalg.eigvals(linear.transition @ (eye - gain @ linear.output)).abs().amax(-1)


def start_uncertainty(plant: PlantDescription, like: Tensor) -> Tensor:
    """How far each start level may be off when only the first reading tells, (tanks,) m."""
    return like.new_tensor([START_SHARE * tank.height for tank in plant.tanks])


def start_beside_noise(plant: PlantDescription, like: Tensor) -> Tensor:
    """The same (tanks,) in units of a reading's noise that is not known: about one, for the first reading has it too.

    More for tanks that are taller than others, in units of the plant's length scale.
    """
    return start_uncertainty(plant, like) / length_scale(plant)


def _radius(linear: Linear, gain: Tensor) -> float:
    return float(spectral_radius(linear, gain).max())


def _filter_gain(linear: Linear, predicted: Tensor, reading: Tensor) -> tuple[Tensor, Tensor]:
    """L = P H' (H P H' + R)^-1, and the standard deviation of the residuals (*batch, sensors)."""
    spread = linear.output @ predicted @ linear.output.mT + reading
    gain = torch.linalg.solve(spread, linear.output @ predicted).mT
    return gain, torch.sqrt(torch.diagonal(spread, dim1=-2, dim2=-1))
