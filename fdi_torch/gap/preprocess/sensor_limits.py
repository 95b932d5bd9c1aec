"""Limits of a sensor's range that the readings show without a model: constant values at an end of the range only.

A rig that clips the noisy reading shows no noise in a clipped segment. A limit that applies before the noise is added
is left to the search for effects. Near a limit the mean of the reading differs from the level by up to 0.4 standard
deviations of the noise, which with 3600 samples is a gap by itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.effects import EFFECTS
from fdi_torch.effects.clipping import ReadingLimit, clipped_noise
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import Noise
from fdi_torch.gap.dataset import DataSet, at_recorded_times
from fdi_torch.plant.description import PlantDescription, Sensor, with_unlimited_sensors
from fdi_torch.plant.effect import Placement
from fdi_torch.recording import Recording

LIMITS = {e.name: e for e in EFFECTS if isinstance(e, ReadingLimit)}
LONGEST_BY_CHANCE = 5  # equal samples in a row that chance explains
CLEAR = 4.0  # standard deviations from a limit beyond which noise is not clipped
FEWEST = 0.1  # smallest share of a sensor's samples from which its noise is estimated
AT_REST = 0.05  # share of equal neighbours inside the range above which the level may simply be at rest


def limits_of(values: Tensor) -> dict[str, float]:
    """Limits that values (S,) of one sensor show, by the name of the effect."""
    if len(values) == 0:
        return {}
    high, low = float(values.max()), float(values.min())
    inside = (torch.diff(values) == 0.0)[(values[1:] != high) & (values[1:] != low)]
    if len(inside) == 0 or float(inside.double().mean()) > AT_REST:
        return {}
    ends = {name: high if limit.upper else low for name, limit in LIMITS.items()}
    return {name: end for name, end in ends.items() if _longest_run(values == end) > LONGEST_BY_CHANCE}


def limits_from_readings(
    plant: PlantDescription,
    recordings: Sequence[Recording],
    nominal_effects: Sequence[Placement],
    library: Sequence[Placement],
) -> list[Placement]:
    """Limits of sensors that all recordings together show and the plant does not have yet, as effects."""
    limits = []
    present, offered = {p.prefix for p in nominal_effects}, {p.prefix for p in library}
    for sensor in plant.sensors:
        values = torch.cat([r.valid_readings(sensor.column) for r in recordings])
        for name, limit in limits_of(values).items():
            placement = Placement(LIMITS[name], sensor.name, {"limit": limit})
            if _of_plant(sensor, name) is None and placement.prefix in offered - present:
                limits.append(placement)
    return limits


def noise_before_clipping(noise: Noise, data: DataSet, predicted: Tensor) -> Noise:
    """The noise before clipping: its level is estimated from the readings far from the limits, by differences of
    neighbours, which contain little model error. The correlation is that of all samples, since short segments determine
    it badly.

    predicted (S, C): about the readings without noise.
    """
    std, residual = noise.std.clone(), data.readings - predicted
    for c, ends in enumerate(_limits_per_sensor(data)):
        unclipped = data.mask[:, c]
        for name, end in ends.items():
            unclipped = unclipped & (_beyond(name, data.readings[:, c], end) < -CLEAR * float(noise.std[c]))
        if ends and int(unclipped.sum()) > FEWEST * int(data.mask[:, c].sum()):
            differences = torch.diff(residual[:, c])[unclipped[1:] & unclipped[:-1]]
            std[c] = torch.sqrt(differences.square().mean() / (2.0 * (1.0 - noise.lag_one[c])))
    return replace(noise, innovation=std / torch.sqrt(noise.energy))


def with_noise_limits(data: DataSet, null: Fit, noise: Noise) -> DataSet:
    """The data set with limits that clip the noise as well, for limits that the readings show and the plant file or
    `limits_from_readings` has.

    null: fit of the data set without further effects.
    """
    if not any(_limits_per_sensor(data)):
        return data
    levels = _unlimited(data, null, noise)
    residual = torch.where(data.mask, data.readings - null.linearised.readings[0], 0.0)
    rms = torch.sqrt(residual.square().sum(dim=0) / data.mask.sum(dim=0))  # the level of slow noise is determined badly
    effects = {p.prefix: p for p in data.nominal_effects}
    for c, (sensor, ends) in enumerate(zip(data.plant.sensors, _limits_per_sensor(data), strict=True)):
        # A row may be the mean of several readings, each of which was clipped.
        a_row = math.sqrt(len(data.recorded(c)) / int(data.mask[:, c].sum()))
        std = a_row * min(float(noise.std[c]), float(rms[c]))
        for name, end in ends.items():
            placement = effects.get(f"{sensor.name}.{name}", Placement(LIMITS[name], sensor.name))
            values = dict(placement.values or {})
            stated = [limit for limit in (values.get("limit"), _of_plant(sensor, name)) if limit is not None]
            if stated and all(abs(limit - end) < std for limit in stated):
                depth = _mean_depth(data, levels, c, name, end, std)
                values = {"limit": end, **values, **clipped_noise(depth, std)}
                effects[placement.prefix] = replace(placement, values=values)
    return replace(data, nominal_effects=tuple(effects.values()))


def _mean_depth(data: DataSet, levels: Tensor, channel: int, name: str, end: float, std: float) -> float:
    """Mean distance of readings from a limit where the level is far beyond it and the reading before is at it, in their
    unit; 0 if there are none. levels (S, C): readings without limits.

    The reading before confirms the predicted level, of which other effects may be left out.
    """
    depths = [levels.new_zeros(0)]
    for k, rows in enumerate(data.rows):
        part = data.alone(k)
        column = part.recording.output_columns([data.plant.sensors[channel].column])[0]
        readings, valid = part.recording.outputs[:, column], part.recording.mask[:, column]
        beyond = valid & (_beyond(name, at_recorded_times(part, levels[rows])[:, channel], end) > CLEAR * std)
        depths.append(-_beyond(name, readings, end)[1:][beyond[1:] & valid[:-1] & (readings[:-1] == end)])
    depth = torch.cat(depths)
    return float(depth.mean()) if len(depth) else 0.0


def _unlimited(data: DataSet, null: Fit, noise: Noise) -> Tensor:
    """Readings (S, C) of a fit if no sensor had a limit."""
    nominal_effects = tuple(p for p in data.nominal_effects if p.effect.name not in LIMITS)
    unlimited = replace(data, plant=with_unlimited_sensors(data.plant), nominal_effects=nominal_effects)
    return Fitter(unlimited, noise).engine(null.candidate, ()).read(null.linearised.levels, null.theta.unsqueeze(0))[0]


def _beyond(name: str, values: Tensor, end: float) -> Tensor:
    """Distance outside a limit, in the readings' unit."""
    return values - end if LIMITS[name].upper else end - values


def _of_plant(sensor: Sensor, name: str) -> float | None:
    """The limit of a sensor in the plant file."""
    return sensor.high if LIMITS[name].upper else sensor.low


def _limits_per_sensor(data: DataSet) -> list[dict[str, float]]:
    """Limits of each sensor that its readings show, as in `limits_of`."""
    return [limits_of(data.recorded(c)) for c in range(len(data.plant.sensors))]


def _longest_run(flags: Tensor) -> int:
    """Length of the longest run of true samples."""
    same, lengths = torch.unique_consecutive(flags, return_counts=True)
    return int((lengths * same).max())
