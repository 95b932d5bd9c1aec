"""What a recording reaches: how long it is, and between what its commands, readings and levels lie."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.constants import reading_at
from fdi_torch.plant.description import Pipe, PlantDescription
from fdi_torch.recording import Recording

Range = tuple[float, float]


@dataclass(frozen=True)
class Reach:
    """duration in s; commands by input channel, readings by sensor, levels (m) by tank: lowest and highest."""

    duration: float
    commands: Mapping[str, Range]
    readings: Mapping[str, Range]
    levels: Mapping[str, Range]


def reach_of(recording: Recording, plant: PlantDescription) -> Reach:
    """Lowest and highest of everything; what was not recorded may have been anywhere from floor to rim."""
    inputs = dict(zip(recording.input_names, recording.inputs.T, strict=True))
    outputs = {n: c[m] for n, c, m in zip(recording.output_names, recording.outputs.T, recording.mask.T, strict=True)}
    readings, levels = {}, {tank.name: (0.0, tank.height) for tank in plant.tanks}
    for sensor in plant.sensors:
        seen = outputs.get(sensor.column)
        if seen is None or len(seen) == 0:
            whole = reading_at(plant, sensor, 0.0), reading_at(plant, sensor, 1.0)
            readings[sensor.name] = min(whole), max(whole)
            continue
        readings[sensor.name] = _range(seen)
        ends = sorted((reading - sensor.offset) / sensor.gain for reading in readings[sensor.name])
        levels[sensor.tank] = max(ends[0], 0.0), max(ends[1], 0.0)
    return Reach(
        duration=float(recording.time[-1] - recording.time[0]),
        commands={c: _range(inputs[c]) for c in plant.channels() if c in inputs},
        readings=readings,
        levels=levels,
    )


def with_levels(reach: Reach, plant: PlantDescription, levels: Tensor) -> Reach:
    """The same, with the levels of the tanks that no sensor sees as a model has them: levels (K, tanks), m."""
    unseen = {t.name: _range(levels[:, i]) for i, t in enumerate(plant.tanks)}
    for sensor in plant.sensors:
        unseen.pop(sensor.tank, None)
    return replace(reach, levels={**reach.levels, **unseen})


def reach_of_all(recordings: Sequence[Recording], plant: PlantDescription) -> Reach:
    """The same over several recordings: the longest, and the lowest and highest of all."""
    each = [reach_of(recording, plant) for recording in recordings]

    def widest(kind: str) -> dict[str, Range]:
        found: dict[str, list[Range]] = {}
        for reach in each:
            for name, ends in getattr(reach, kind).items():
                found.setdefault(name, []).append(ends)
        return {name: (min(low for low, _ in r), max(high for _, high in r)) for name, r in found.items()}

    return Reach(max(r.duration for r in each), widest("commands"), widest("readings"), widest("levels"))


def bounded(space: ParameterSpace, last: float) -> ParameterSpace:
    """The same space with onsets, ramps and the like, which may otherwise last for ever, kept within the recording.

    last: when it ends, s.
    """
    endless = [p.name for p in space if p.unit == "s" and math.isinf(p.high)]
    for name in endless:
        space = space.with_changes(name, high=max(last, space[name].nominal))
    return space


def heads(plant: PlantDescription, pipe: str, reach: Reach) -> Range:
    """The least and the greatest head that may have driven a pipe or an outlet, without sign, m."""
    found = plant.component(pipe)
    assert isinstance(found, Pipe)
    low, high = (max(level - found.elevation, 0.0) for level in reach.levels[found.source])
    if found.is_outlet:
        return low, high
    far_low, far_high = (max(level - found.elevation, 0.0) for level in reach.levels[found.target])
    return max(low - far_high, far_low - high, 0.0), max(high - far_low, far_high - low)


def onsets(reach: Reach) -> list[float]:
    """Moments from which a fit finds any onset between them, s: a step that is misplaced by more than its neighbours'
    distance is no start for a fit, for what it should explain lies elsewhere."""
    return inside((0.0, reach.duration), 9)


def inside(reached: Range, count: int) -> list[float]:
    """`count` values evenly within a range, its ends left out."""
    low, high = reached
    return [low + (high - low) * (k + 1) / (count + 1) for k in range(count)]


def _range(values: Tensor) -> Range:
    return float(values.min()), float(values.max())
