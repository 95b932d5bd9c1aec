"""The operating range of a recording: its duration, and the ranges of its commands, readings and levels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.constants import reading_at
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

Range = tuple[float, float]


@dataclass(frozen=True)
class OperatingRange:
    """Duration (s), and (lowest, highest) of commands by input channel, readings by sensor, levels (m) by tank."""

    duration: float
    commands: Mapping[str, Range]
    readings: Mapping[str, Range]
    levels: Mapping[str, Range]


def operating_range_of(recording: Recording, plant: PlantDescription) -> OperatingRange:
    """The operating range of one recording; a level without a reading is taken to span floor to rim."""
    inputs = dict(zip(recording.input_names, recording.inputs.T, strict=True))
    outputs = {n: c[m] for n, c, m in zip(recording.output_names, recording.outputs.T, recording.mask.T, strict=True)}
    readings, levels = {}, {tank.name: (0.0, tank.height) for tank in plant.tanks}
    for sensor in plant.sensors:
        values = outputs.get(sensor.column)
        if values is None or len(values) == 0:
            ends = reading_at(plant, sensor, 0.0), reading_at(plant, sensor, 1.0)
            readings[sensor.name] = min(ends), max(ends)
            continue
        readings[sensor.name] = _range(values)
        low, high = sorted((reading - sensor.offset) / sensor.gain for reading in readings[sensor.name])
        levels[sensor.tank] = max(low, 0.0), max(high, 0.0)
    return OperatingRange(
        duration=float(recording.time[-1] - recording.time[0]),
        commands={c: _range(inputs[c]) for c in plant.channels() if c in inputs},
        readings=readings,
        levels=levels,
    )


def with_simulated_levels(
    operating_range: OperatingRange, plant: PlantDescription, levels: Float[torch.Tensor, "K tanks"]
) -> OperatingRange:
    """The same range, with the levels of tanks without a sensor taken from a simulation: levels (K, tanks), m."""
    unmeasured = {t.name: _range(levels[:, i]) for i, t in enumerate(plant.tanks)}
    for sensor in plant.sensors:
        unmeasured.pop(sensor.tank, None)
    return replace(operating_range, levels={**operating_range.levels, **unmeasured})


def operating_range_of_all(recordings: Sequence[Recording], plant: PlantDescription) -> OperatingRange:
    """The union of the operating ranges of several recordings, with the longest duration."""
    each = [operating_range_of(recording, plant) for recording in recordings]

    def union(kind: str) -> dict[str, Range]:
        ranges: dict[str, list[Range]] = {}
        for one in each:
            for name, ends in getattr(one, kind).items():
                ranges.setdefault(name, []).append(ends)
        return {name: (min(low for low, _ in r), max(high for _, high in r)) for name, r in ranges.items()}

    return OperatingRange(max(r.duration for r in each), union("commands"), union("readings"), union("levels"))


def bounded_by_recording(space: ParameterSpace, end: float) -> ParameterSpace:
    """The same space with every time (onset, ramp, ...) that has no upper bound limited to the recording's end, s."""
    unbounded = [p.name for p in space if p.unit == "s" and math.isinf(p.high)]
    for name in unbounded:
        space = space.with_changes(name, high=max(end, space[name].nominal))
    return space


def head_range(plant: PlantDescription, pipe: str, operating_range: OperatingRange) -> Range:
    """Minimum and maximum absolute driving head of a pipe or an outlet, m."""
    component, levels = plant.pipe(pipe), operating_range.levels
    low, high = (max(level - component.elevation, 0.0) for level in levels[component.source])
    if component.is_outlet:
        return low, high
    far_low, far_high = (max(level - component.elevation, 0.0) for level in levels[component.target])
    return max(low - far_high, far_low - high, 0.0), max(high - far_low, far_high - low)


def onset_grid(operating_range: OperatingRange) -> list[float]:
    """Onset times from which a fit converges to any onset, s.

    The cost has a local minimum about the true onset; nine evenly spaced starts put one within reach of it.
    """
    return interior_points((0.0, operating_range.duration), 9)


def timed_starts(starts: Sequence[Mapping[str, float]], operating_range: OperatingRange) -> list[dict[str, float]]:
    """These starts from the beginning of the recording, from each onset of the grid, and growing beyond its end."""
    duration = operating_range.duration
    # A ramp that ended at the last sample would start the fit at a kink, where rounding decides on the slope.
    growing = {"onset": 0.3 * duration, "ramp": 0.75 * duration}
    times = [{}, *({"onset": instant} for instant in onset_grid(operating_range)), growing]
    return [{**start, **time} for time in times for start in starts]


def interior_points(ends: Range, count: int) -> list[float]:
    """`count` evenly spaced values strictly inside a range."""
    low, high = ends
    return [low + (high - low) * (k + 1) / (count + 1) for k in range(count)]


def _range(values: torch.Tensor) -> Range:
    return float(values.min()), float(values.max())
