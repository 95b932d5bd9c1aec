"""Estimate of the noise model of `FlowFilter`: random flows into the tanks, and the measurement noise of the sensors.

It maximises the likelihood of the observer's residuals (`estimate/state_noise.py`), averaged over the initial levels
and the errors of constants. Without that, errors of constants would count as random flows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.estimate.kalman import Propagation
from fdi_torch.estimate.noise_model import SensorNoise, StateNoise
from fdi_torch.estimate.state_noise import CORRELATION_TIMES, Likelihood, estimate_state_noise
from fdi_torch.monitor.flow_filter import FlowFilter, forcing
from fdi_torch.monitor.observer_gain import Gain, Linear

FIRST_TIME = 20.0  # correlation time at which the optimisation starts, in sampling intervals
# The correlation time is 2^e sampling intervals, searched with this step of e; flows are white at the lowest e.
WHITE, SLOWEST, STEP = -1.0, 8.5, 1.0
CORRELATIONS = (0.3, 0.5, 0.7, 0.85, 0.95)  # candidates for that of the sensors' noise
FIRST_UNIT = 0.1  # initial flow per sample of the optimisation, in standard deviations of a level's measurement noise


def estimate_flow_filter(
    linear: Linear,
    observer: Gain,
    residual: Tensor,
    effects: Tensor,
    expected: Tensor,
    reading_std: Tensor,
    start_std: Tensor,
    interval: float,
    correlation: float = 0.0,
) -> tuple[FlowFilter, float]:
    """The filter for the noise that is most likely with an observer's residuals (S, sensors), and its log-likelihood.

    effects (P, S, sensors): of the errors of constants on the residuals, per standard deviation of their priors, the
    means of which are `expected` (P,).
    reading_std (sensors,): first guess of the measurement noise. correlation: of its neighbouring values. Raises
    BuildError without a compiler.
    """
    first = StateNoise(_usual_flow(linear, reading_std, start_std), FIRST_TIME * interval, torch.ones_like(reading_std))
    free = free_residual(linear, observer, residual)
    by_constants = free_residual(linear, observer, effects).nan_to_num().permute(1, 2, 0)
    known = linear, first, reading_std, observer, start_std, interval
    start = FlowFilter(*known, free, by_constants, expected, correlation=correlation)
    flows, likely = _likeliest(start, [(free, by_constants)], CORRELATION_TIMES)
    return flows, likely.log_likelihood


def likeliest_correlation(estimate: Callable[[float], tuple[FlowFilter, float]]) -> tuple[FlowFilter, float]:
    """The most likely filter with correlated noise of sensors, and its log-likelihood. The search starts in the middle
    of CORRELATIONS and goes on to the better neighbour as long as there is one.

    estimate: `estimate_flow_filter` with a correlation.
    """
    best = len(CORRELATIONS) // 2
    found = {best: estimate(CORRELATIONS[best])}

    def at(i: int) -> float:
        if i not in found:
            found[i] = estimate(CORRELATIONS[i])
        return found[i][1]

    for step in (1, -1):
        while 0 <= best + step < len(CORRELATIONS) and at(best + step) > at(best):
            best += step
    return found[best]


def _likeliest(
    start: FlowFilter, segments: Sequence[tuple[Tensor, Tensor]], times: Sequence[float] = ()
) -> tuple[FlowFilter, Likelihood]:
    """The filter with the most likely noise, by a search from that of `start` on, and its likelihood.

    segments: residuals (S, sensors) without corrections, NaN where missing, each from unknown levels on, and their
    derivatives (S, sensors, P) by the errors of constants. The search begins at the best of these correlation times,
    in sampling intervals, and that of `start`.
    """
    segments = [segment for segment in segments if len(segment[0])]
    linear, (free, by_constants) = start.linear, map(torch.cat, zip(*segments, strict=True))
    count, tanks = len(free), len(start.start_std)
    fresh, by_levels = torch.zeros(count, dtype=torch.bool), free.new_zeros(*free.shape, len(segments) * tanks)
    first = 0
    for k, (segment, _) in enumerate(segments):
        last, fresh[first] = first + len(segment), True
        moved = by_initial_levels(linear, len(segment))[..., :tanks] * start.start_std
        by_levels[first:last, :, k * tanks : (k + 1) * tanks] = moved
        first = last
    a, b, c = (x.expand(count, *x.shape) for x in (linear.transition, forcing(linear.transition), linear.output))
    propagation = Propagation(a, b, c, free.new_full((count,), start.interval), fresh, torch.isfinite(free))
    sensors = SensorNoise(start.reading_std, torch.full_like(start.reading_std, start.correlation))
    columns = torch.cat([by_levels, by_constants], dim=-1)
    unit, ones = _usual_flow(linear, start.reading_std, start.start_std), free.new_ones(columns.shape[-1])
    residual = free.nan_to_num() - by_constants @ start.expected

    def solved(noise: StateNoise) -> Likelihood:
        priors = ones, 0.0 * ones
        given = propagation, sensors, residual, columns, *priors, unit, noise
        return estimate_state_noise(*given, climb=False)

    noise = replace(start.noise, scale=torch.ones_like(start.reading_std))
    likely = _with_likeliest_time(solved, noise, start.interval, times)
    return replace(start, noise=likely.noise, reading_std=likely.noise.scale * start.reading_std), likely


def _with_likeliest_time(
    solved: Callable[[StateNoise], Likelihood], start: StateNoise, interval: float, times: Sequence[float]
) -> Likelihood:
    """The most likely noise over all correlation times.

    The search climbs on a grid of correlation times, from the best of `times` (in sampling intervals) and that of
    `start`, and ends at the maximum of a parabola through the last three points. solved: the most likely noise among
    those with the correlation time of its argument.
    """
    first = _exponent(start.correlation_time / interval)
    found = {first: solved(start)}

    def at(e: float) -> float:
        if e not in found:
            nearest = min(found, key=lambda other: abs(other - e))
            noise, time = found[nearest].noise, interval * 2.0**e if e > WHITE else 0.0
            # keeps the variance of a flow integrated over a long time, intensity^2 max(2 tau, interval)
            intensity = noise.intensity * 2.0 ** (0.5 * (nearest - e))
            found[e] = solved(replace(noise, correlation_time=time, intensity=intensity))
        return found[e].log_likelihood

    best = max(sorted({first, *map(_exponent, times)}, key=lambda e: abs(e - first)), key=at)
    for step in (STEP, -STEP):
        while at(further := min(max(best + step, WHITE), SLOWEST)) > at(best):
            best = further
    below, above = best - STEP, best + STEP
    if below > WHITE and above < SLOWEST and (bend := at(below) - 2.0 * at(best) + at(above)) < 0.0:
        at(best + 0.5 * STEP * (at(below) - at(above)) / bend)
    likeliest = max(found.values(), key=lambda likely: likely.log_likelihood)
    return replace(likeliest, start_log_likelihood=found[first].start_log_likelihood)


def _exponent(time: float) -> float:
    """e of a correlation time in sampling intervals."""
    return math.log2(time) if time else WHITE


def _usual_flow(linear: Linear, reading_std: Tensor, start_std: Tensor) -> Tensor:
    """Order of magnitude of each tank's random flow, (tanks,) m per sample."""
    metres = reading_std / torch.linalg.vector_norm(linear.output, dim=-1)
    return FIRST_UNIT * metres.median() * torch.ones_like(start_std)


def with_usual_flows(flows: FlowFilter) -> FlowFilter:
    """The filter with the flows from which the search for them begins, and without data."""
    usual = _usual_flow(flows.linear, flows.reading_std, flows.start_std)
    noise = replace(flows.noise, intensity=usual, correlation_time=FIRST_TIME * flows.interval)
    return replace(flows, noise=noise, learnt=flows.learnt[:0], by_constants=flows.by_constants[:0])


def learning_from(flows: FlowFilter, residual: Tensor, effects: Tensor, number: int) -> tuple[FlowFilter, float, float]:
    """The filter with the most likely noise, given its earlier data and further residuals, the log-likelihood of these
    data, and what it gained over the present noise.

    residual (S, sensors): scaled to the steady variance, of the observer's samples from `number` on. effects (P, S,
    sensors): of the errors of constants on it, last of those beside which the flows were learnt. The filter
    restarts there, because the covariance of its state under the present noise does not hold for other noise.
    """
    own = effects[len(effects) - flows.by_constants.shape[-1] :]
    further, by_constants = (free_residual(flows.linear, flows.observer, x, number) for x in (residual, own))
    segments = [(flows.learnt, flows.by_constants), (further, by_constants.nan_to_num().permute(1, 2, 0))]
    flows = replace(flows, begins=number)
    searches = [_likeliest(flows, segments)]
    if not len(flows.learnt):  # then the present flows may be far from these
        searches.append(_likeliest(with_usual_flows(flows), segments, CORRELATION_TIMES))
    likeliest, at = max(searches, key=lambda search: search[1].log_likelihood)
    return likeliest, at.log_likelihood, at.log_likelihood - searches[0][1].start_log_likelihood


def free_residual(linear: Linear, observer: Gain, residual: Tensor, number: int = 0) -> Tensor:
    """What the residual (*batch, S, sensors) would be without the observer's corrections: r_k + C xi_k, with
    xi_{k+1} = A (xi_k + L_k r_k). NaN where a reading is missing, which makes no correction.

    number: samples of the run before the first.
    """
    count = residual.shape[-2]
    raw = residual * observer.spread(number, count)
    steps = observer.table(number, count) @ raw.nan_to_num().unsqueeze(-1)
    shift, path = torch.zeros_like(steps[..., 0, :, :]), []
    for step in steps.unbind(-3):
        path.append(shift)
        shift = linear.transition @ (shift + step)
    return raw + (linear.output @ torch.stack(path, -3)).squeeze(-1)


def by_initial_levels(linear: Linear, count: int) -> Tensor:
    """Derivatives of the readings by the initial states, C A^k, (S, sensors, n)."""
    power, path = torch.eye(len(linear.transition), dtype=linear.transition.dtype), []
    for _ in range(count):
        path.append(linear.output @ power)
        power = linear.transition @ power
    return torch.stack(path)
