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
from functools import partial

import torch

from fdi_torch.estimate.evidence import RARE
from fdi_torch.estimate.noise_model import SCATTER, StateNoise, Wander
from fdi_torch.estimate.state_noise import CORRELATION_TIMES, LOG_BOUND
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
from fdi_torch.gap.trajectory_problem import GIVE_UP_SHARE
from fdi_torch.simulate.linearised import Linearised

SMALLEST_DRIFT = 0.1  # as a share of the sensor's noise


def random_flows(
    regression: DiscrepancyRegression, noise: StateNoise, places: Sequence[str], base: float, needed: float
) -> list[LocalizedDiscrepancy]:
    """An unknown random flow into the tank with the largest one, if that explains more than `needed`; else nothing.

    Of the random flows that every plant has, the logarithms of the standard deviations are normal about a common mean.
    That of an unknown flow is uniform over the range of the estimate. needed: as in `drifting_sensors`.
    """
    fitter, fit, linearised = regression.fitter, regression.fit, regression.linearised
    largest = int(noise.intensity.argmax())
    tank = fitter.data.plant.tanks[largest].name
    if tank not in places or len(noise.intensity) < 2:
        return []
    cost = math.log(2.0 * LOG_BOUND / (SCATTER * math.sqrt(2.0 * math.pi)))

    def gain_under(apart: StateNoise) -> float:
        return log_evidence(fitter, fit, apart, linearised) - base - cost

    gain, apart = _most_likely(regression, linearised, gain_under, replace(noise, apart=largest), needed)
    if gain < needed:
        return []
    size = _moved(with_disturbances(fitter, fit, apart, linearised), linearised)
    return [_random_process(regression, tank, linearised, apart, gain, gain + cost, 1, size)]


def drifting_sensors(
    regression: DiscrepancyRegression, noise: StateNoise, places: Sequence[str], base: float, needed: float
) -> list[LocalizedDiscrepancy]:
    """A drift at each sensor, without those whose gain in log evidence is below `needed`, or far below another's."""
    fitter, fit, quiet = regression.fitter, regression.fit, nearly_without_disturbances(noise)

    def gain_at(place: str, noise: StateNoise) -> float:
        assert noise.wander is not None
        return log_evidence(fitter, fit, noise, regression.at(place)[1]) - base - _drift_cost(fitter, noise.wander)

    starts: list[tuple[float, str, StateNoise]] = []
    for place in places:
        if (channel := regression.sensor(place)) is not None:
            start = _initial_drift(fitter, regression.at(place)[1], quiet, channel)
            starts.append((gain_at(place, start), place, start))
    drifts: list[LocalizedDiscrepancy] = []
    noise_gain = 0.0
    for tried, (initial, place, start) in enumerate(sorted(starts, key=lambda s: -s[0])):
        if tried and initial + noise_gain < needed:
            break
        linearised = regression.at(place)[1]
        found = _most_likely(regression, linearised, partial(gain_at, place), start, needed)
        gain, drift = max(found, (initial, start), key=lambda f: f[0])
        noise_gain, needed = max(noise_gain, gain - initial), max(needed, gain + math.log(RARE))
        assert drift.wander is not None
        if gain >= needed and not is_rounding_error(fitter, place, drift.wander.std):
            likelihood, size = gain + _drift_cost(fitter, drift.wander), _drift_size(fitter, drift.wander)
            drifts.append(_random_process(regression, place, linearised, drift, gain, likelihood, 2, size))
    return drifts


def _most_likely(
    regression: DiscrepancyRegression,
    linearised: Linearised,
    gain_under: Callable[[StateNoise], float],
    start: StateNoise,
    needed: float,
) -> tuple[float, StateNoise]:
    """The largest gain of a random process, and its most likely parameters.

    Its correlation time stays that of `start` if its gain is then below GIVE_UP_SHARE of what it lacks to be relevant.
    """
    fitter, fit = regression.fitter, regression.fit
    first = estimate_disturbances(fitter, fit, linearised, start=start, climb=False).noise
    gain = gain_under(first)
    if gain < GIVE_UP_SHARE * (needed - gain):
        return gain, first
    climbed = estimate_disturbances(fitter, fit, linearised, start=first).noise
    return max((gain, first), (gain_under(climbed), climbed), key=lambda f: f[0])


def _random_process(
    regression: DiscrepancyRegression,
    place: str,
    linearised: Linearised,
    noise: StateNoise,
    gain: float,
    log_likelihood: float,
    parameters: int,
    size: float,
) -> LocalizedDiscrepancy:
    """A random process as a discrepancy without regressors."""
    fitter, fit = regression.fitter, regression.fit
    nothing = torch.zeros_like(fitter.data.readings)
    under = with_disturbances(fitter, fit, noise, linearised)
    estimate = Estimate.beside(under, fit, linearised, nothing.unsqueeze(-1)[..., :0], nothing.new_zeros(0))
    level_filter = regression.level_filter
    return LocalizedDiscrepancy(
        place, gain, log_likelihood, parameters, nothing, None, size, None, fit, noise, estimate, level_filter
    )


def _moved(fitter: Fitter, linearised: Linearised) -> float:
    """Norm of the change of the readings by the disturbances, in units of the sensor noise."""
    assert fitter.whitening is not None
    moved = fitter.whitening.smoothed(fitter.data.readings - linearised.readings[0])
    of_sensors = (fitter.whitening.own.propagation.output @ moved.unsqueeze(-1)).squeeze(-1)
    return float(torch.linalg.vector_norm(torch.where(fitter.data.mask, of_sensors, 0.0) / fitter.noise.std))


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
