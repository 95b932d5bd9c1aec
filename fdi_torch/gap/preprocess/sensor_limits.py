"""What the values themselves tell of a sensor's range: readings that stand still at one end of it and nowhere else.

A rig clips its noisy reading, so that a clipped stretch shows no noise at all. This is told without a model, as
rounding is; a limit that the level meets before the noise is added is left to the search. Near such an end the mean of
a reading is not what the level says, by up to 0.4 of the noise's deviation: with 3600 samples a gap by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from fdi_torch.effects import effect
from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.dataset import DataSet
from fdi_torch.gap.noise_model import Noise
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.recording import Recording

LIMITS = ("sensor_saturation", "sensor_floor")
LONGEST_BY_CHANCE = 5  # samples in a row of one value
CLEAR = 4.0  # standard deviations from an end of the range, from which noise is not clipped
FEWEST = 0.1  # share of a sensor's samples that tell of its noise
STILL = 0.05  # share of steps without change, the ends left out, above which a channel may just be at rest


def limits_of(values: Tensor) -> dict[str, float]:
    """values (S,) of one sensor -> where it ends: 'sensor_saturation' and 'sensor_floor', as far as it was seen to."""
    same = torch.diff(values) == 0.0
    found = {}
    ends = dict(zip(LIMITS, (float(values.max()), float(values.min())), strict=True))
    at_end = (values[1:] == values.max()) | (values[1:] == values.min())
    elsewhere = same[~at_end]
    if len(elsewhere) == 0 or float(elsewhere.double().mean()) > STILL:
        return {}
    for name, end in ends.items():
        if _longest_run(values == end) > LONGEST_BY_CHANCE:
            found[name] = end
    return found


def limits_from_readings(
    plant: PlantDescription,
    recordings: Sequence[Recording],
    believed: Sequence[Placement],
    library: Sequence[Placement],
) -> list[Placement]:
    """Limits of sensors that the plant does not have yet, as effects with their values; of all recordings together."""
    told = []
    known, offered = {p.prefix for p in believed}, {p.prefix for p in library}
    for sensor in plant.sensors:
        values = [r.outputs[r.mask[:, i], i] for r in recordings for i in _columns(r, sensor.column)]
        if not values:
            continue
        given = dict(zip(LIMITS, (sensor.high, sensor.low), strict=True))
        for name, limit in limits_of(torch.cat(values)).items():
            placement = Placement(effect(name), sensor.name, {"limit": limit})
            if given[name] is None and placement.prefix in offered - known:
                told.append(placement)
    return told


def _columns(recording: Recording, name: str) -> list[int]:
    return [i for i, column in enumerate(recording.output_names) if column == name]


def noise_before_clipping(noise: Noise, data: DataSet, believed: Tensor) -> Noise:
    """The noise before the range clips it: each sensor's level as the samples far from its ends tell it, by how much
    neighbours differ, of which little is the model's. The colour is that of all samples: pieces tell it badly.

    believed (S, C): about what would be read.
    """
    innovation, residual = noise.innovation.clone(), data.readings - believed
    for c, ends in enumerate(_ends(data)):
        seen = free = data.mask[:, c]
        for name, end in ends.items():
            free = free & (_beyond(name, believed[:, c], end) < -CLEAR * float(noise.std[c]))
        if ends and int(free.sum()) > FEWEST * int(seen.sum()):
            innovation[c] *= _roughness(residual[:, c], free) / _roughness(residual[:, c], seen, data.rows)
    return replace(noise, innovation=innovation)


def _roughness(x: Tensor, which: Tensor, tapered: Sequence[slice] = ()) -> float:
    """How much neighbours among some samples (S,) differ: the root of their mean square.

    tapered: stretches whose middle counts most, as in the noise's spectrum.
    """
    weight = torch.ones_like(x) if not tapered else torch.zeros_like(x)
    for rows in tapered:
        weight[rows] = torch.hann_window(len(x[rows]), periodic=False, dtype=x.dtype) ** 2
    weight = weight[1:] * (which[1:] & which[:-1])
    return float((weight * torch.diff(x) ** 2).sum() / weight.sum()) ** 0.5


def with_noise_limits(data: DataSet, null: Fit, noise: Noise) -> DataSet:
    """The same, in which limits that the readings show, and the plant file or `told_limits` name, clip the noise too.

    null: a fit of the subject without further effects.
    """
    if not any(_ends(data)):
        return data
    levels = _unlimited(data, null, noise)
    left = torch.where(data.mask, data.readings - null.linearised.readings[0], 0.0)
    most = torch.sqrt(left.square().sum(dim=0) / data.mask.sum(dim=0))  # a slow colour's level is told badly
    believed = {p.prefix: p for p in data.nominal_effects}
    for c, (sensor, ends) in enumerate(zip(data.plant.sensors, _ends(data), strict=True)):
        std = min(float(noise.std[c]), float(most[c]))
        given = dict(zip(LIMITS, (sensor.high, sensor.low), strict=True))
        for name, end in ends.items():
            placement = believed.get(f"{sensor.name}.{name}", Placement(effect(name), sensor.name))
            values = dict(placement.values or {})
            known = [limit for limit in (values.get("limit"), given[name]) if limit is not None]
            if known and all(abs(limit - end) < std for limit in known):
                beyond = data.mask[:, c] & (_beyond(name, levels[:, c], end) > CLEAR * std)
                behind = _met_again(data.readings[beyond, c] == end)
                values = {"limit": end, **values, "noise": std, "behind": behind}
                believed[placement.prefix] = replace(placement, values=values)
    return replace(data, nominal_effects=tuple(believed.values()))


def _unlimited(data: DataSet, null: Fit, noise: Noise) -> Tensor:
    """What a fit would read if no sensor had a limit, (S, C), in the readings' unit."""
    sensors = tuple(replace(s, low=None, high=None) for s in data.plant.sensors)
    believed = tuple(p for p in data.nominal_effects if p.effect.name not in LIMITS)
    free = replace(data, plant=replace(data.plant, sensors=sensors), nominal_effects=believed)
    return Fitter(free, noise).engine(null.candidate, ()).read(null.linearised.levels, null.theta.unsqueeze(0))[0]


def _beyond(name: str, values: Tensor, end: float) -> Tensor:
    """How far outside of an end of the range, in the readings' unit."""
    return values - end if name == LIMITS[0] else end - values


def _met_again(at_end: Tensor) -> float:
    """Which share of the noise comes behind the limit: of samples far beyond, half of those with it are off the end."""
    return min(2.0 * float((~at_end).double().mean()), 1.0) if len(at_end) else 0.0


def _ends(data: DataSet) -> list[dict[str, float]]:
    """Of each sensor, as in `limits_of`."""
    return [limits_of(data.readings[seen, c]) for c, seen in enumerate(data.mask.T)]


def _longest_run(yes: Tensor) -> int:
    """How many samples in a row, at most, say yes."""
    edges = torch.diff(yes.to(torch.int64), prepend=yes.new_zeros(1, dtype=torch.int64))
    starts = (edges == 1).nonzero().flatten()
    ends = (edges == -1).nonzero().flatten()
    if len(ends) < len(starts):
        ends = torch.cat([ends, ends.new_tensor([len(yes)])])
    return int((ends - starts).max()) if len(starts) else 0
