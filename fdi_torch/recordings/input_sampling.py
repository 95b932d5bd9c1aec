"""Commands that move faster than they are sampled, so that the flow between two samples is not known.

A command with a low correlation of successive samples is *undersampled*, unless it is held from each sample to the
next. A regression of the tank's rate of change shows whether it is held, because no level depends on a later command:

    A (h[k+1] - h[k]) / d = a + b[-2] u[k-2] + b[-1] u[k-1] + b[0] u[k] + b[1] u[k+1] + error

A held command has b[1] = 0, whatever its gain, delay or lag. If a command switches between the samples k and k + 1,
the flow of that interval depends on both values, so that b[1] > 0. A controller gives b[1] < 0, because it acts against
a rise of the level.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from statistics import NormalDist

import torch

from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.metered_flow import MeteredFlow
from fdi_torch.recording import Recording
from fdi_torch.recordings.plant_limits import ChannelFinding
from fdi_torch.recordings.repeated_readings import BY_CHANCE, resolution
from fdi_torch.sample_noise import sample_noise

TWO_SAMPLES_A_HOLD = 0.5
"""Correlation of successive samples of a command that is held for two samples: 1 - (sampling interval) / (hold)."""
CERTAIN = 1.96
"""97.5 % quantile of the standard normal distribution."""
PAST = 2
"""Earlier samples of the command on which a change of the level may depend, by a lag or a delay."""


def undersampled_inputs(recording: Recording, plant: PlantDescription) -> Iterator[ChannelFinding]:
    """Commands that change too fast for their sampling.

    Such a command is, at a confidence of 97.5 %, held for less than two samples on average, or oscillates with fewer
    than six samples per period, and is so strong that the unknown flow of one interval moves the level by more than the
    noise of its readings.

    If a command switches at random and is held for a time h, samples at intervals d <= h have the correlation 1 - d /
    h; samples of a sine of period T have cos(2 pi d / T). The standard error of the correlation over N independent
    samples is 1 / sqrt(N).
    """
    for pump in plant.metered_flows():
        areas = [tank.area for tank in plant.tanks if tank.name == pump.near_tank]
        if pump.channel not in recording.input_names or not areas:
            continue
        name, values = pump.channel, recording.inputs[:, recording.input_names.index(pump.channel)]
        both_known = torch.isfinite(values[:-1]) & torch.isfinite(values[1:])
        before, after = values[:-1][both_known], values[1:][both_known]
        variance = float(torch.cat([before, after]).var(correction=0)) if len(before) else 0.0
        unknown_change = pump.gain * variance**0.5 * recording.interval / areas[0]
        if not unknown_change > _scatter(recording, plant, pump.near_tank):
            continue
        correlation = 1.0 - float((after - before).square().mean()) / (2.0 * variance)
        if correlation + CERTAIN / len(before) ** 0.5 < TWO_SAMPLES_A_HOLD:
            text = (
                f"moves about as fast as it is sampled: successive samples correlate by {correlation:.2f}, those of a "
                f"command that is held for two samples by {TWO_SAMPLES_A_HOLD:g}. What it does between samples is not "
                "recorded; unless it is held from each sample to the next, its flow is unknown and the error looks "
                "like an effect of the pump: log it faster, or its mean over each interval"
            )
            yield ChannelFinding(
                "undersampled", name, text, {"correlation": correlation, "interval": recording.interval}
            )


def inputs_not_held(recording: Recording, plant: PlantDescription) -> list[str]:
    """The undersampled commands that are certainly not held from each sample to the next.

    The test has a false-alarm probability of BY_CHANCE per recording, divided equally among the commands. It says
    nothing of a command that its own past determines, such as a sine, or of one that is interpolated linearly.
    """
    names = {finding.channel for finding in undersampled_inputs(recording, plant)}
    if recording.hold != "zero_order" or not names:
        return []
    limit = NormalDist().inv_cdf(1.0 - BY_CHANCE / len(names))
    pumps = {pump.channel: pump for pump in plant.metered_flows()}
    return [name for name in pumps if name in names and _score_of_the_next(recording, plant, pumps[name]) > limit]


def _score_of_the_next(recording: Recording, plant: PlantDescription, pump: MeteredFlow) -> float:
    """b[1] of a pump's command over its standard error, in the direction of its flow; least squares."""
    sensor = next((s for s in plant.sensors if s.tank == pump.near_tank), None)
    if sensor is None or sensor.column not in recording.output_names:
        return 0.0
    rows = torch.arange(PAST, len(recording) - 1)
    readings = recording.readings[:, recording.output_names.index(sensor.column)]
    into = 1.0 if pump.target == pump.near_tank else -1.0
    change = torch.diff(readings)[rows] / torch.diff(recording.time)[rows] * into * math.copysign(1.0, sensor.gain)
    command = recording.inputs[:, recording.input_names.index(pump.channel)]
    # The command to come is the last regressor: by QR, its coefficient and variance need the last row of R alone.
    regressors = torch.stack([command[rows + lag] for lag in range(-PAST, 2)], dim=1)
    known = torch.isfinite(change) & torch.isfinite(regressors).all(dim=1)
    x, y = regressors[known], change[known]
    freedom = len(x) - x.shape[1] - 1
    if freedom < 1 or int(torch.linalg.matrix_rank(x - x.mean(dim=0))) < x.shape[1]:
        return 0.0
    q, r = torch.linalg.qr(x - x.mean(dim=0))
    y = y - y.mean()
    explained = q.T @ y
    error = float((y - q @ explained).square().sum() / freedom) ** 0.5
    return float(explained[-1] * r[-1, -1].sign()) / error if error > 0.0 else 0.0


def _scatter(recording: Recording, plant: PlantDescription, tank: str) -> float:
    """Smallest noise or resolution of a tank's readings, as a level, m; infinite without a sensor."""
    scatters = [torch.inf]
    for sensor in plant.sensors:
        values = recording.valid_readings(sensor.column) / sensor.gain
        if sensor.tank == tank and len(values) > 2:
            scatters.append(max(float(sample_noise(values[:, None])), resolution(values)))
    return min(scatters)
