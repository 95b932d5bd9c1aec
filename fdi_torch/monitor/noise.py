"""Process and measurement noise of a plant, from one fault-free recording, and the observer that suits them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.monitor.gain import Gain, Linear, kalman_gain, linearised, riccati, start_beside_noise
from fdi_torch.monitor.observer import Observation, Observer, bound, first_levels
from fdi_torch.monitor.samples import Samples, usual_interval
from fdi_torch.monitor.stepper import Stepper
from fdi_torch.monitor.whitening import Whitening, score_whitenings, with_slow_variance
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork

# log10 of the levels' wander within a sample over the noise of a reading, both in m: from "none" to "all".
EXPONENTS = tuple(0.5 * i - 4.0 for i in range(11))
FINE = tuple(0.125 * i for i in range(-4, 5))


@dataclass(frozen=True)
class Noise:
    """What a fault-free recording tells of its noise.

    process_std (tanks,) m: how far each level wanders in a sample. reading_std (sensors,) in the readings' units.
    ratio: between the two, both as levels. whitening: the colour left in the residual. gain: of the observer for them.
    interval: usual one between samples there, s.
    """

    process_std: Tensor
    reading_std: Tensor
    ratio: float
    whitening: Whitening
    gain: Gain
    interval: float = 1.0


def learn_noise(
    network: TankNetwork,
    fault_free: Samples,
    space: ParameterSpace | None = None,
    theta: Tensor | None = None,
    levels: Tensor | None = None,
    longest_step: float | None = None,
) -> tuple[Noise, Observation]:
    """The ratio of process to measurement noise and the colour of the residual that are the most likely together.

    fault_free: one recording. levels (tanks,) at its start, where known. All ratios run side by side, one lane each.
    """
    if fault_free.batch:
        raise ValueError(f"expected one fault-free recording, got a batch of {tuple(fault_free.batch)}")
    linear = operating_point(network, fault_free, space, theta, longest_step)

    def attempt(exponents: Sequence[float]) -> list[_Attempt]:
        gain = _gain(network, linear, network.nominal.new_tensor(exponents))
        lanes = fault_free.readings.expand(len(exponents), *fault_free.readings.shape)
        seen = Observer(network, gain, space, theta, longest_step).run(replace(fault_free, readings=lanes), levels)
        return [_attempt(seen, lane, exponent) for lane, exponent in enumerate(exponents)]

    coarse = min(attempt(EXPONENTS), key=lambda tried: tried.score)
    fine = attempt([coarse.exponent + offset for offset in FINE])
    best = attempt([_valley(fine)])[0]
    return replace(_noise(network, linear, best), interval=usual_interval(fault_free.time)), best.seen


def noise_of_gain(
    network: TankNetwork,
    gain: Gain,
    fault_free: Samples,
    space: ParameterSpace | None = None,
    theta: Tensor | None = None,
    longest_step: float | None = None,
) -> tuple[Noise, Observation]:
    """For an observer whose gain is given: the colour of its residual. What of it is process noise stays open (NaN)."""
    seen = Observer(network, gain, space, theta, longest_step).run(fault_free)
    settled = seen.last(max(len(fault_free) - len(gain.opening), len(fault_free) // 2))
    whitening = with_slow_variance(score_whitenings(settled.steady_residual)[0][1], settled.steady_residual)
    unknown = network.nominal.new_full((len(network.description.tanks),), torch.nan)
    std = settled.steady_residual.square().nanmean(dim=0).sqrt()
    return Noise(unknown, std, float("nan"), whitening, gain, usual_interval(fault_free.time)), seen


@dataclass(frozen=True)
class _Attempt:
    """An observer for one ratio, 10^exponent: how likely what it saw is (less is more), and the colour left in it."""

    exponent: float
    score: float
    whitening: Whitening
    seen: Observation


def _attempt(seen: Observation, lane: int, exponent: float) -> _Attempt:
    own = Observation(seen.time, seen.state[lane], seen.residual[lane], seen.inflation[..., lane, :, :], seen.tanks)
    score, whitening = score_whitenings(own.steady_residual)[0]
    return _Attempt(exponent, score + 2.0 * float(torch.log(own.inflation).sum()), whitening, own)


def _valley(tried: Sequence[_Attempt]) -> float:
    """The exponent at the bottom of the parabola through the best attempt and its neighbours."""
    scores = [t.score for t in tried]
    i = min(range(1, len(tried) - 1), key=lambda lane: scores[lane])
    step, bend = tried[i].exponent - tried[i - 1].exponent, scores[i - 1] - 2.0 * scores[i] + scores[i + 1]
    if bend <= 0.0:
        return tried[i].exponent
    shift = 0.5 * step * (scores[i - 1] - scores[i + 1]) / bend
    return tried[i].exponent + min(max(shift, -step), step)


def _gain(network: TankNetwork, linear: Linear, exponents: Tensor) -> Gain:
    """Gains for ratios 10^exponents, one lane each."""
    unit = torch.linalg.vector_norm(linear.output, dim=-1)  # reading per metre of its tank's level
    shares = (10.0**exponents).unsqueeze(-1)
    start_std = start_beside_noise(network.description, unit)
    return kalman_gain(linear, shares.expand(-1, len(start_std)), unit.expand(len(exponents), -1), start_std)


def _noise(network: TankNetwork, linear: Linear, best: _Attempt) -> Noise:
    """Both noises from the innovations' spread, H P H' + R, at the best ratio."""
    unit, share = torch.linalg.vector_norm(linear.output, dim=-1), network.nominal.new_tensor(10.0**best.exponent)
    tanks = len(network.description.tanks)
    predicted = riccati(linear, torch.diag_embed(share.expand(tanks) ** 2), torch.diag(unit**2))
    spread = torch.diagonal(linear.output @ predicted @ linear.output.mT) + unit**2
    reading_std = torch.sqrt(best.seen.steady_residual.square().nanmean(dim=0) / spread) * unit
    process_std = share * (reading_std / unit).mean().expand(tanks)
    gain = _gain(network, linear, share.log10().unsqueeze(0))
    own = Gain(gain.steady[0], gain.opening[:, 0], gain.inflation[:, 0])
    whitening = with_slow_variance(best.whitening, best.seen.steady_residual)
    return Noise(process_std, reading_std, float(share), whitening, own)


def operating_point(
    network: TankNetwork,
    samples: Samples,
    space: ParameterSpace | None = None,
    theta: Tensor | None = None,
    longest_step: float | None = None,
) -> Linear:
    """The plant over one sampling interval about the middle of what a recording visits."""
    values = bound(network, space, theta)
    known = torch.nan_to_num(samples.inputs, nan=0.0).mean(dim=-2)
    middle = Samples(
        samples.time, samples.inputs, samples.readings.nanmedian(dim=-2, keepdim=True).values, samples.hold
    )
    levels = first_levels(network, middle, values)
    floor = 0.02 * tank_heights(network)
    span = float(torch.diff(samples.time).median())
    return linearised(Stepper(network, longest_step), torch.maximum(levels, floor), known, span, values)


def tank_heights(network: TankNetwork) -> Tensor:
    """Height of each tank, (tanks,) m."""
    return network.nominal.new_tensor([tank.height for tank in network.description.tanks])
