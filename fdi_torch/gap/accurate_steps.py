"""Division of the integration steps in which levels move too fast for the midpoint rule.

An error of s / sqrt(S) in each of S readings with noise s adds one to chi-square: the rule may err by no more in a
step. Where it does follows from the plant file (a tank that exchanges its water fast, levels that meet) and from the
readings (a level that falls fast because its tank starts far above an overflow that the file lacks). Square roots and
rims are smoothed over the length of a step, so that their error becomes smaller with the step.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.estimate.misfit import least_noise
from fdi_torch.gap.dataset import DataSet, RecordingPart
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.network import TankNetwork
from fdi_torch.sample_noise import sample_noise
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.experiment import divided

ROUNDS = 4
"""Limit of divisions by the plant's errors: the error of a root at zero head falls slower than with the square."""
MOST_DIVISION, MOST_ADDED = 8, 20_000
"""A recording grows at most by this factor, and by this number of steps; it then keeps larger errors."""


def with_accurate_steps(data: DataSet) -> DataSet:
    """The data set with its steps divided until each is as accurate as the noise of the readings requires."""
    network = TankNetwork(data.plant, data.nominal_effects)
    return replace(data, experiments=tuple(_accurate(network, part).experiment for part in data.parts))


def _accurate(network: TankNetwork, part: RecordingPart) -> RecordingPart:
    recording, order = part.recording, part.recording.output_columns(network.description.outputs())
    least = least_noise(recording.outputs[:, order].nan_to_num(), recording.mask[:, order])
    noise = torch.maximum(sample_noise(part.readings.nan_to_num(), part.mask), least)
    errors = errors_by_readings(part, noise)
    most = min(MOST_DIVISION * len(errors), len(errors) + MOST_ADDED)
    # Noise alone makes errors of 0.19 (standard deviation): those above 1, five of these, are of the levels.
    part = _divided(part, torch.where(errors > 1.0, errors, 0.0), most)
    for _ in range(ROUNDS):
        before, part = part, _divided(part, errors_by_plant(network, part, noise), most)
        if part is before:
            break
    return part


def _divided(part: RecordingPart, errors: Float[Tensor, " K"], most: int) -> RecordingPart:
    """The part with each step divided until its error, which falls with the square of its length, is admissible.

    most: steps of the result, by larger errors if need be.
    """
    admissible = 1.0 / math.sqrt(len(part.readings))
    while True:
        counts = torch.ceil(torch.sqrt(errors / admissible)).clamp(min=1.0)
        if float(counts.max()) == 1.0:
            return part
        if float(counts.sum()) <= most:
            return replace(part, experiment=divided(part.experiment, counts.to(torch.int64)))
        admissible *= 2.0


def errors_by_readings(part: RecordingPart, noise: Float[Tensor, " C"]) -> Float[Tensor, " K"]:
    """Error of the midpoint rule in each step, dt^3 |d^3h/dt^3| / 24, in units of the readings' noise (C,).

    The third derivative comes from divided differences of four neighbouring samples; of all sensors and all such
    quadruples around the step the largest counts. White noise alone makes errors of 0.19 (standard deviation).
    """
    times, steps = part.experiment.sample_times, part.experiment.steps
    derivative = torch.where(part.mask, part.readings, torch.nan) / noise
    for order in (1, 2, 3):
        derivative = order * torch.diff(derivative, dim=0) / (times[order:] - times[:-order]).unsqueeze(1)
    if not len(derivative):
        return torch.zeros_like(steps)
    largest = derivative.abs().nan_to_num(nan=0.0).amax(dim=1)
    around = torch.nn.functional.max_pool1d(largest[None, None], 3, 1, padding=1)[0, 0]
    middle = part.experiment.nodes[:-1] + 0.5 * steps
    enclosing = (torch.searchsorted(times, middle) - 2).clamp(0, len(around) - 1)
    return around[enclosing] * steps**3 / 24.0


def errors_by_plant(network: TankNetwork, part: RecordingPart, noise: Float[Tensor, " C"]) -> Float[Tensor, " K"]:
    """Largest error of a level by one step in place of two of half its length, in units of the readings' noise (C,).

    The levels are those of the plant from the first readings. A tank without a sensor has the least noise of all.
    """
    plant, whole = network.description, part.experiment
    halves = divided(whole, torch.full((len(whole.steps),), 2))
    space = ParameterSpace(network.constants[f"{t.name}.start_level"] for t in plant.tanks)
    theta = space.vector(part.first_levels(plant)).unsqueeze(0)
    fine = Collocation(network, space, halves, by=())
    levels = fine.trajectories(theta)[:, ::2]
    coarse = Collocation(network, space, whole, by=())
    slope = torch.diff(levels, dim=1) / whole.steps.unsqueeze(1)
    misfit = coarse.rates(0.5 * (levels[:, 1:] + levels[:, :-1]), theta) - slope
    errors = (coarse.linearise(theta, levels).gain[0] @ misfit[0].unsqueeze(-1)).squeeze(-1).abs()
    return (errors / _noise_of_levels(plant, noise, errors.shape[-1])).amax(dim=-1).nan_to_num(nan=0.0, posinf=0.0)


def _noise_of_levels(plant: PlantDescription, noise: Float[Tensor, " C"], count: int) -> Float[Tensor, " n"]:
    """Noise of the sensors as noise of the levels, m; the least of all for the other states of the plant."""
    spans = noise.new_tensor([reading_span(plant, s) / plant.tank(s.tank).height for s in plant.sensors])
    of_sensors, tanks = noise / spans, [t.name for t in plant.tanks]
    of_levels = of_sensors.min().repeat(count)
    for sensor, std in zip(plant.sensors, of_sensors, strict=True):
        of_levels[tanks.index(sensor.tank)] = std
    return of_levels
