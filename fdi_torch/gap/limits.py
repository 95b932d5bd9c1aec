"""What the values themselves tell of a sensor's range: readings that stand still at one end of it and nowhere else.

A rig clips its noisy reading, so that a clipped stretch shows no noise at all. This is told without a model, as
rounding is; a limit that the level meets before the noise is added is left to the search.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.effects import effect
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.recording import Recording

LONGEST_BY_CHANCE = 5  # samples in a row of one value
STILL = 0.05  # share of steps without change, the ends left out, above which a channel may just be at rest


def limits_of(values: Tensor) -> dict[str, float]:
    """values (S,) of one sensor -> where it ends: 'sensor_saturation' and 'sensor_floor', as far as it was seen to."""
    same = torch.diff(values) == 0.0
    found = {}
    ends = {"sensor_saturation": float(values.max()), "sensor_floor": float(values.min())}
    at_end = (values[1:] == values.max()) | (values[1:] == values.min())
    elsewhere = same[~at_end]
    if len(elsewhere) == 0 or float(elsewhere.double().mean()) > STILL:
        return {}
    for name, end in ends.items():
        if _longest_run(values == end) > LONGEST_BY_CHANCE:
            found[name] = end
    return found


def told_limits(
    plant: PlantDescription, recording: Recording, believed: Sequence[Placement], library: Sequence[Placement]
) -> list[Placement]:
    """Limits of sensors that the plant does not have yet, as effects with their values."""
    told = []
    known, offered = {p.prefix for p in believed}, {p.prefix for p in library}
    for sensor in plant.sensors:
        if sensor.column not in recording.output_names:
            continue
        i = recording.output_names.index(sensor.column)
        given = {"sensor_saturation": sensor.high, "sensor_floor": sensor.low}
        for name, limit in limits_of(recording.outputs[recording.mask[:, i], i]).items():
            placement = Placement(effect(name), sensor.name, {"limit": limit})
            if given[name] is None and placement.prefix in offered - known:
                told.append(placement)
    return told


def _longest_run(yes: Tensor) -> int:
    """How many samples in a row, at most, say yes."""
    edges = torch.diff(yes.to(torch.int64), prepend=yes.new_zeros(1, dtype=torch.int64))
    starts = (edges == 1).nonzero().flatten()
    ends = (edges == -1).nonzero().flatten()
    if len(ends) < len(starts):
        ends = torch.cat([ends, ends.new_tensor([len(yes)])])
    return int((ends - starts).max()) if len(starts) else 0
