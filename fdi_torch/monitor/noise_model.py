"""Process and measurement noise of a plant from one fault-free recording, and the Kalman gain for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from fdi_torch.monitor.flow_filter import FlowFilter
from fdi_torch.monitor.flow_noise_estimate import estimate_flow_filter, likeliest_correlation
from fdi_torch.monitor.law_errors import STEP, ConstantErrors, prior_std, raised
from fdi_torch.monitor.observer import Observation, Observer, bind_parameters, initial_levels
from fdi_torch.monitor.observer_gain import (
    Gain,
    Linear,
    kalman_gain,
    linearised,
    riccati,
    start_beside_noise,
    start_uncertainty,
    with_effects,
)
from fdi_torch.monitor.samples import Samples, mean_interval, usual_interval
from fdi_torch.monitor.stepper import Stepper
from fdi_torch.monitor.whitening import Whitening, score_whitenings
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.build import BuildError

# log10 of the process noise per sample over the measurement noise, both in m: from negligible to dominant.
EXPONENTS = tuple(0.5 * i - 4.0 for i in range(11))
FINE = tuple(0.125 * i for i in range(-4, 5))


@dataclass(frozen=True)
class NoiseModel:
    """Noise model identified from a fault-free recording.

    reading_std (sensors,): measurement noise in the readings' units. ratio: process over measurement noise, both as
    levels. whitening: of the observer's residual. gain: of the observer. interval: usual time between
    samples, s. constants: errors of constants with a tolerance.
    """

    reading_std: Tensor
    ratio: float
    whitening: Whitening
    gain: Gain
    interval: float = 1.0
    constants: ConstantErrors = field(default_factory=ConstantErrors)


def learn_noise(
    network: TankNetwork,
    fault_free: Samples,
    space: ParameterSpace | None = None,
    theta: Tensor | None = None,
    levels: Tensor | None = None,
    longest_step: float | None = None,
    uncertain: Sequence[int] = (),
    expected: Tensor | None = None,
) -> tuple[NoiseModel, Observation]:
    """Identify the noise by maximum likelihood over the ratio of process to measurement noise, and run its observer.

    fault_free: one recording. levels (tanks,): initial levels if known. uncertain: columns of `space` that are P
    constants with errors, beside which the noise is learnt. expected (P,): means of their priors, in standard
    deviations of these from theta; zero by default. All candidate ratios run in parallel.
    """
    if fault_free.batch:
        raise ValueError(f"expected one fault-free recording, got a batch of {tuple(fault_free.batch)}")
    linear = operating_point(network, fault_free, space, theta, longest_step)

    def candidates(exponents: Sequence[float]) -> list[_Candidate]:
        gain = _gain(network, linear, network.nominal.new_tensor(exponents))
        lanes = fault_free.readings.expand(len(exponents), *fault_free.readings.shape)
        seen = Observer(network, gain, space, theta, longest_step).run(replace(fault_free, readings=lanes), levels)
        return [_candidate(seen, lane, exponent) for lane, exponent in enumerate(exponents)]

    coarse = min(candidates(EXPONENTS), key=lambda candidate: candidate.score)
    fine = candidates([coarse.exponent + offset for offset in FINE])
    best = candidates([_minimizing_exponent(fine)])[0]
    gain = _gain(network, linear, network.nominal.new_tensor([best.exponent]))
    gain = Gain(gain.steady[0], gain.opening[:, 0], gain.inflation[:, 0])
    seen, effects = best.seen, best.seen.residual.new_zeros(0, *best.seen.residual.shape)
    if uncertain and space is not None and theta is not None:
        observed = partial(Observer, network, gain, longest_step=longest_step)
        effects = effects_of_constants(observed, fault_free, space, theta, uncertain, levels)
    expected = effects.new_zeros(len(effects)) if expected is None else expected
    noise = _noise(network, linear, gain, best, effects, expected)
    return replace(noise, interval=usual_interval(fault_free.time)), seen


def learn_beside_errors(
    network: TankNetwork,
    samples: Samples,
    space: ParameterSpace,
    theta: Tensor,
    uncertain: Sequence[int],
    step: float,
) -> tuple[NoiseModel, Observation, Tensor, Tensor]:
    """The noise beside errors of constants, the run of its observer, theta with the most likely values of these, and
    the means of their priors, in standard deviations of these from there.

    About the most likely values their effects are linear enough: one Gauss-Newton step from the values of theta.
    """
    noise, seen = learn_noise(network, samples, space, theta, longest_step=step, uncertain=uncertain)
    if not uncertain or noise.whitening.flows is None:
        return noise, seen, theta, theta.new_zeros(len(uncertain))
    observed = partial(Observer, network, noise.gain, longest_step=step)
    effects = effects_of_constants(observed, samples, space, theta, uncertain)
    errors = _likely_errors(noise.whitening.flows, seen.steady_residual, effects)
    likeliest = theta.clone()
    likeliest[list(uncertain)] -= errors * prior_std(space)[list(uncertain)]
    return *learn_noise(network, samples, space, likeliest, None, step, uncertain, -errors), likeliest, -errors


def effects_of_constants(
    observed: Callable[..., Observer],
    samples: Samples,
    space: ParameterSpace,
    theta: Tensor,
    columns: Sequence[int],
    levels: Tensor | None = None,
) -> Tensor:
    """Effects (P, S, sensors) of P constants of a space on the residuals of an observer, per standard deviation of
    their priors. observed(space, theta): the observer with such values (*batch, P)."""
    lanes = torch.cat([theta[None], raised(theta, space, columns)])
    every = replace(samples, readings=samples.readings.expand(len(lanes), *samples.readings.shape))
    residual = observed(space, lanes).run(every, levels).steady_residual
    return (residual[1:] - residual[0]) / STEP


def _likely_errors(flows: FlowFilter, residual: Tensor, effects: Tensor) -> Tensor:
    """The most likely coefficients (P,) of effects (P, S, sensors) in residuals, beside random flows. They are normal
    with the means `flows.expected` and unit variance."""
    std = flows.innovation_std
    rest = residual - _sum(effects, flows.expected)
    x, y = ((flows(values, states=False)[0] / std).nan_to_num() for values in (effects, rest))
    x, y = x.flatten(1), y.flatten()
    return flows.expected + torch.linalg.solve(x @ x.mT + torch.eye(len(x), dtype=x.dtype), x @ y)


def _sum(effects: Tensor, coefficients: Tensor) -> Tensor:
    """Sum (S, sensors) of effects (P, S, sensors) with these coefficients (P,)."""
    return torch.tensordot(coefficients, effects.nan_to_num(), 1)


@dataclass(frozen=True)
class _Candidate:
    """An observer for the noise ratio 10^exponent. score: -2 log-likelihood plus the penalty for the whitening."""

    exponent: float
    score: float
    whitening: Whitening
    seen: Observation


def _candidate(seen: Observation, lane: int, exponent: float) -> _Candidate:
    single = Observation(seen.time, seen.state[lane], seen.residual[lane], seen.inflation[..., lane, :, :])
    score, whitening = score_whitenings(single.steady_residual)[0]
    return _Candidate(exponent, score + 2.0 * float(torch.log(single.inflation).sum()), whitening, single)


def _minimizing_exponent(candidates: Sequence[_Candidate]) -> float:
    """The exponent at the minimum of the parabola through the best candidate and its neighbours."""
    scores = [candidate.score for candidate in candidates]
    i = min(range(1, len(candidates) - 1), key=lambda lane: scores[lane])
    step, bend = candidates[i].exponent - candidates[i - 1].exponent, scores[i - 1] - 2.0 * scores[i] + scores[i + 1]
    if bend <= 0.0:
        return candidates[i].exponent
    shift = 0.5 * step * (scores[i - 1] - scores[i + 1]) / bend
    return candidates[i].exponent + min(max(shift, -step), step)


def _gain(network: TankNetwork, linear: Linear, exponents: Tensor) -> Gain:
    """Gains for the ratios 10^exponents, as a batch."""
    unit = torch.linalg.vector_norm(linear.output, dim=-1)  # reading per metre of its tank's level
    shares = (10.0**exponents).unsqueeze(-1)
    start_std = start_beside_noise(network.description, unit)
    return kalman_gain(linear, shares.expand(-1, len(start_std)), unit.expand(len(exponents), -1), start_std)


def _noise(
    network: TankNetwork, linear: Linear, gain: Gain, best: _Candidate, effects: Tensor, expected: Tensor
) -> NoiseModel:
    """The measurement noise from the innovations' covariance, H P H' + R, at the best ratio."""
    unit, ratio = torch.linalg.vector_norm(linear.output, dim=-1), network.nominal.new_tensor(10.0**best.exponent)
    process = with_effects(ratio.expand(len(network.description.tanks)), network.order)
    predicted = riccati(linear, torch.diag_embed(process**2), torch.diag(unit**2))
    variance = torch.diagonal(linear.output @ predicted @ linear.output.mT) + unit**2
    reading_std = torch.sqrt(best.seen.steady_residual.square().nanmean(dim=0) / variance) * unit
    whitening = _whitening(network, linear, gain, best.seen, effects, expected)
    return NoiseModel(reading_std, float(ratio), whitening, gain)


def _whitening(
    network: TankNetwork, linear: Linear, gain: Gain, seen: Observation, effects: Tensor, expected: Tensor
) -> Whitening:
    """Whitening of an observer's residuals: random flows by their Kalman filter, what remains by an autoregression.

    First the noise of the sensors is taken as white. If the residuals remain correlated, or if the random flows are
    uncorrelated in time, the sensors' noise may be correlated: flows and sensor noise are then estimated together.
    Without a compiler there is no flow filter.
    """
    residual, interval = seen.steady_residual, mean_interval(seen.time)
    std, start = residual.square().nanmean(dim=0).sqrt(), start_uncertainty(network.description, residual)
    estimate = partial(estimate_flow_filter, linear, gain, residual, effects, expected, std, start, interval)
    try:
        flows, log_likelihood = estimate(0.0)
    except BuildError:
        return score_whitenings(residual)[0][1]
    score, whitening = _scored(flows, log_likelihood, residual, effects)
    if whitening.order or not flows.noise.correlation_time:
        score_of_correlated, of_correlated = _scored(*likeliest_correlation(estimate), residual, effects)
        if score_of_correlated + math.log(len(residual)) < score:  # the correlation is one more parameter
            return of_correlated
    return whitening


def _scored(flows: FlowFilter, log_likelihood: float, residual: Tensor, effects: Tensor) -> tuple[float, Whitening]:
    """-2 log-likelihood with the penalty for what whitens the innovations of a flow filter, without the most likely
    errors of constants, and that whitening."""
    fits = score_whitenings(flows(residual - _sum(effects, _likely_errors(flows, residual, effects)))[0])
    without = next(score for score, whitening in fits if not whitening.order and not bool(whitening.mean.any()))
    return fits[0][0] - without - 2.0 * log_likelihood, replace(fits[0][1], flows=flows)


def operating_point(
    network: TankNetwork,
    samples: Samples,
    space: ParameterSpace | None = None,
    theta: Tensor | None = None,
    longest_step: float | None = None,
) -> Linear:
    """The plant linearised over one sampling interval about the median readings and mean inputs of a recording."""
    values = bind_parameters(network, space, theta)
    inputs = torch.nan_to_num(samples.inputs, nan=0.0).mean(dim=-2)
    median = Samples(
        samples.time, samples.inputs, samples.readings.nanmedian(dim=-2, keepdim=True).values, samples.hold
    )
    levels = initial_levels(network, median, values)
    heights = network.nominal.new_tensor([tank.height for tank in network.description.tanks])
    lowest = 0.02 * heights  # the outflow law has no finite slope in an empty tank
    span = mean_interval(samples.time)
    return linearised(Stepper(network, longest_step), torch.maximum(levels, lowest), inputs, span, values)
