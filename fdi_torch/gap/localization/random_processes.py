"""Discrepancies that are random processes: the flow into one tank, and the drift of one sensor.

The random flow into one tank may be an unknown flow there instead of one of the disturbances, which are of one order of
magnitude in all tanks. A drift is a random process of a sensor alone, with unknown size and correlation time. Random
flows move levels, which later readings of other sensors show; a drift shows in one channel only. Its parameters are
estimated together with the other noise. Its evidence is the likelihood of the innovations less the cost of its
parameters: the prior of the size is log-uniform between a tenth of the sensor noise and the range of the readings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from fdi_torch.estimate.evidence import RARE
from fdi_torch.estimate.kalman import SCATTER, StateNoise, Wander
from fdi_torch.estimate.state_noise import CORRELATION_TIMES, LOG_BOUND
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.localization.discrepancy_regression import DiscrepancyRegression
from fdi_torch.gap.localization.localized_discrepancy import (
    Estimate,
    LocalizedDiscrepancy,
    is_rounding_error,
    log_evidence,
    nearly_without_disturbances,
)
from fdi_torch.gap.marginal_likelihood import estimate_disturbances, with_disturbances
from fdi_torch.gap.trajectory_problem import SHARE
from fdi_torch.simulate.linearised import Linearised

SMALLEST_DRIFT = 0.1  # as a share of the sensor's noise


def random_flows(
    regression: DiscrepancyRegression, noise: StateNoise, places: Sequence[str], base: float, needed: float
) -> list[LocalizedDiscrepancy]:
    """The tank with the largest disturbance, if more likely an unknown flow than one of the disturbances of the plant.

    The prior of its logarithm is uniform over the range of the estimate instead of normal about the others'. needed: as
    in `drifting_sensors`.
    """
    fitter, fit, linearised = regression.fitter, regression.fit, regression.linearised
    largest = int(noise.intensity.argmax())
    tank = fitter.data.plant.tanks[largest].name
    if tank not in places or len(noise.intensity) < 2:
        return []
    cost = math.log(2.0 * LOG_BOUND / (SCATTER * math.sqrt(2.0 * math.pi)))
    nothing = torch.zeros_like(fitter.data.readings)

    def evaluate(apart: StateNoise) -> LocalizedDiscrepancy:
        gain = log_evidence(fitter, fit, apart, linearised) - base - cost
        under = with_disturbances(fitter, fit, apart, linearised)
        size, estimate = _moved(under, linearised), _estimate(under, fit, linearised)
        return LocalizedDiscrepancy(tank, gain, gain + cost, 1, nothing, None, size, None, fit, apart, estimate)

    return [_most_likely(regression, linearised, evaluate, replace(noise, apart=largest), needed)]


def _most_likely(
    regression: DiscrepancyRegression,
    linearised: Linearised,
    evaluate: Callable[[StateNoise], LocalizedDiscrepancy],
    start: StateNoise,
    needed: float,
) -> LocalizedDiscrepancy:
    """A random process with its most likely parameters.

    Its correlation time stays that of `start` if its gain is then below SHARE of what it lacks to be relevant.
    """
    fitter, fit = regression.fitter, regression.fit
    first = evaluate(estimate_disturbances(fitter, fit, linearised, start=start, climb=False).noise)
    if first.gain < SHARE * (needed - first.gain):
        return first
    climbed = evaluate(estimate_disturbances(fitter, fit, linearised, start=first.noise).noise)
    return max(first, climbed, key=lambda d: d.gain)


def _estimate(under: Fitter, fit: Fit, linearised: Linearised) -> Estimate:
    nothing = linearised.readings.new_zeros(*linearised.readings.shape[1:], 0)
    return Estimate.beside(under, fit, linearised, nothing, nothing.new_zeros(0))


def _moved(fitter: Fitter, linearised: Linearised) -> float:
    """Norm of the change of the readings by the disturbances, in units of the sensor noise."""
    whitening, plant = fitter.whitening, fitter.data.plant
    assert whitening is not None
    moved = whitening.smoothed(fitter.data.readings - linearised.readings[0])
    names = [t.name for t in plant.tanks]
    of_sensors = moved[:, [names.index(s.tank) for s in plant.sensors]]
    return float(torch.linalg.vector_norm(torch.where(fitter.data.mask, of_sensors, 0.0) / fitter.noise.std))


def drifting_sensors(
    regression: DiscrepancyRegression, noise: StateNoise, places: Sequence[str], base: float, needed: float
) -> list[LocalizedDiscrepancy]:
    """A drift at each sensor, without those whose gain in log evidence cannot reach `needed`."""
    fitter, fit = regression.fitter, regression.fit

    def evaluate(noise: StateNoise) -> LocalizedDiscrepancy:
        assert noise.wander is not None
        sensor = fitter.data.plant.sensors[noise.wander.channel].name
        linearised = regression.at(sensor)[1]
        gain = log_evidence(fitter, fit, noise, linearised) - base
        cost = _drift_cost(fitter, noise.wander)
        nothing, size = torch.zeros_like(fitter.data.readings), _drift_size(fitter, noise.wander)
        estimate = _estimate(with_disturbances(fitter, fit, noise, linearised), fit, linearised)
        return LocalizedDiscrepancy(sensor, gain - cost, gain, 2, nothing, None, size, None, fit, noise, estimate)

    starts = [
        _initial_drift(fitter, regression.at(p)[1], nearly_without_disturbances(noise), channel)
        for p in places
        if (channel := regression.sensor(p)) is not None
    ]
    drifts: list[LocalizedDiscrepancy] = []
    noise_gain = 0.0
    for initial in sorted(map(evaluate, starts), key=lambda d: d.gain, reverse=True):
        if drifts and initial.gain + noise_gain < needed:
            break
        found = _most_likely(regression, regression.at(initial.location)[1], evaluate, initial.noise, needed)
        best = max(initial, found, key=lambda d: d.gain)
        noise_gain = max(noise_gain, best.gain - initial.gain)
        needed = max(needed, best.gain + math.log(RARE))
        assert best.noise.wander is not None
        if not is_rounding_error(fitter, best.location, best.noise.wander.std):
            drifts.append(best)
    return drifts


def _initial_drift(fitter: Fitter, linearised: Linearised, quiet: StateNoise, channel: int) -> StateNoise:
    """Start of the optimisation: the whole residual of the sensor is drift. quiet: nearly no random flows."""
    valid = fitter.data.mask[:, channel]
    residual = (fitter.data.readings - linearised.readings[0])[valid, channel]
    std = max(float(residual.square().mean().sqrt()), float(fitter.noise.std[channel]))
    return replace(quiet, wander=Wander(channel, std, CORRELATION_TIMES[3] * fitter.data.row_spacing))


def _drift_cost(fitter: Fitter, drift: Wander) -> float:
    """Cost of the parameters of a drift, nats: correlation time, smoothness, and size."""
    valid = fitter.data.mask[:, drift.channel]
    readings = fitter.data.readings[valid, drift.channel]
    noise = float(fitter.noise.std[drift.channel])
    width = math.log(max(float(readings.max() - readings.min()), noise) / (SMALLEST_DRIFT * noise))
    values = max(int(valid.sum()) * fitter.data.row_spacing / drift.correlation_time, 1.0)
    return math.log(2 * (len(CORRELATION_TIMES) - 1)) + max(math.log(width * math.sqrt(values / math.pi)), 0.0)


def _drift_size(fitter: Fitter, drift: Wander) -> float:
    """Norm of the drift in units of the sensor's noise."""
    count = float(fitter.data.mask[:, drift.channel].sum())
    return math.sqrt(count) * drift.std / float(fitter.noise.std[drift.channel])
