"""Checks of a recording's channels against the plant: units, rims, and limits of pumps and valves; and the findings of
all checks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist

import torch
from torch import Tensor

from fdi_torch.plant.description import PlantDescription, Sensor, Tank, with_tolerances
from fdi_torch.plant.metered_flow import MeteredFlow
from fdi_torch.quantities import quantity_text, significant
from fdi_torch.recording import Recording
from fdi_torch.recordings.plant_units import EXCESSIVE, doubtful_units, refusal
from fdi_torch.sample_noise import sample_noise


@dataclass(frozen=True)
class ChannelFinding:
    """kind: read, clock, gap, constant, constant input, clipped, frozen, quantised, held, range, rim, unit, missing,
    empty, few, on change, undersampled, unknown, stuck or slip. values: the numbers stated in `text`, by name, SI.
    """

    kind: str
    channel: str
    text: str
    values: Mapping[str, float] = field(default_factory=dict)


RIM_MARGIN = 0.02
"""A level within this share of the rim may be at it; overflowing water stands a few millimetres above it."""
CHANCE = 0.05
"""Probability with which noise alone may make a recording deny a rim."""
FAR_ABOVE = 2.0
"""Height of a tank whose rim is unknown, in highest levels that were read in it."""
SMALL_SHARE = 0.01
"""The unit is suspect if all values are below this share of the limit, if a level is above ten times the limit, or a
command above EXCESSIVE times."""


@dataclass(frozen=True)
class DeniedRim:
    """A rim that readings deny: by the plant file, their water would stand above it. count, highest (m): of those."""

    sensor: Sensor
    tank: Tank
    count: int
    highest: float

    @property
    def text(self) -> str:
        name, rim, highest = self.tank.name, *(_level(each, self.sensor) for each in (self.tank.height, self.highest))
        return (
            f"{self.sensor.column}: {self.count} readings lie above the rim of {name}, up to {highest} of {rim}, which "
            f"neither noise nor tolerances explain; correct tanks.{name}.height, or gain and offset of "
            f"{self.sensor.name} if it reads too high: until then no cause that is found can be relied on"
        )


def denied_rims(plant: PlantDescription, recording: Recording) -> list[DeniedRim]:
    """The rims that a recording denies.

    A reading counts as above the rim if it exceeds RIM_MARGIN, the tolerances of height, gain and offset, and noise by
    their quantiles of 1 - CHANCE. Noise alone lets r successive readings exceed with a probability of CHANCE^r, and in
    one of N places with N CHANCE^r, so that a rim is denied by a run of r > 1 + ln N / ln(1 / CHANCE) readings: not by
    a spike. Sensors with effects in the plant file are not examined.
    """
    located = {effect.location for effect in plant.effects}
    sensors = [s for s in plant.sensors if s.column in recording.output_names and s.name not in located]
    return [denied for sensor in sensors if (denied := _denied(plant, sensor, recording))]


def denied_by(plant: PlantDescription, recordings: Iterable[Recording]) -> list[DeniedRim]:
    """The rims that recordings deny, those that are trusted left out."""
    return [each for r in recordings if not r.trusted for each in denied_rims(plant, r)]


def expect_no_denied_rim(plant: PlantDescription, recording: Recording) -> None:
    """Raises ValueError if the recording denies a rim, unless it is trusted."""
    if denied := denied_by(plant, [recording]):
        raise ValueError(refusal(recording, "; ".join(each.text for each in denied)))


def _denied(plant: PlantDescription, sensor: Sensor, recording: Recording) -> DeniedRim | None:
    values = recording.valid_readings(sensor.column)
    tank, share = plant.tank(sensor.tank), plant.tolerances.get
    levels = (values - sensor.offset) / sensor.gain
    noise = float(sample_noise(values.unsqueeze(1))) / abs(sensor.gain)
    relative = math.hypot(share(f"{tank.name}.height", 0.0), share(f"{sensor.name}.gain", 0.0)) * tank.height
    inexact = math.hypot(relative, share(f"{sensor.name}.offset", 0.0) / sensor.gain)
    margin = RIM_MARGIN * tank.height + NormalDist().inv_cdf(1.0 - CHANCE) * (noise + inexact)
    above = levels > tank.height + margin
    needed = 2 + int(math.log(max(len(levels), 1)) / math.log(1.0 / CHANCE))
    if len(levels) < max(needed, 3) or not bool(above.unfold(0, needed, 1).all(dim=1).any()):
        return None
    return DeniedRim(sensor, tank, int(above.sum()), float(levels.max()))


def with_rims_unknown(plant: PlantDescription, recordings: Sequence[Recording]) -> PlantDescription:
    """The plant with tanks so high that they never overflow where the recordings, unless trusted, deny their rims."""
    heights: dict[str, float] = {}
    for each in denied_by(plant, recordings):
        heights[each.tank.name] = max(heights.get(each.tank.name, 0.0), FAR_ABOVE * each.highest)
    tanks = tuple(replace(t, height=heights.get(t.name, t.height)) for t in plant.tanks)
    unknown = {f"{name}.height" for name in heights}
    return with_tolerances(replace(plant, tanks=tanks), lambda name: str(name) not in unknown)


def plant_findings(recording: Recording, plant: PlantDescription) -> list[ChannelFinding]:
    """Findings by the plant's limits and, where these call no unit wrong, by the volume balance of its tanks."""
    findings = list(_limit_findings(recording, plant))
    settled = recording.trusted or any(finding.kind == "unit" for finding in findings)
    doubts = [] if settled else doubtful_units(plant, recording)
    return findings + [ChannelFinding("unit", columns, text) for columns, text in doubts]


def _limit_findings(recording: Recording, plant: PlantDescription) -> Iterator[ChannelFinding]:
    """Findings of all sensors, pumps, transfers and valves that the recording has."""
    denied = {each.sensor.column: each for each in denied_by(plant, [recording])}
    for sensor in plant.sensors:
        if sensor.column in recording.output_names:
            column = recording.output_names.index(sensor.column)
            valid = recording.mask[:, column]
            readings, time = recording.outputs[valid, column], recording.time[valid]
            yield from _level_findings(sensor, plant, readings, time, denied.get(sensor.column))
    yield from input_findings(recording, plant)


def input_findings(recording: Recording, plant: PlantDescription) -> Iterator[ChannelFinding]:
    """Findings of the pumps, transfers and valves that the recording has."""
    for pump in plant.metered_flows():
        if pump.channel in recording.input_names:
            yield from _pump_findings(pump, recording.inputs[:, recording.input_names.index(pump.channel)])
    for valve in dict.fromkeys(pipe.valve for pipe in plant.pipes if pipe.valve):
        if valve in recording.input_names:
            yield from _valve_findings(valve, recording.inputs[:, recording.input_names.index(valve)])


def _level_findings(
    sensor: Sensor, plant: PlantDescription, readings: Tensor, time: Tensor, denied: DeniedRim | None
) -> Iterator[ChannelFinding]:
    """Findings about the valid readings (K,) of a sensor at the times (K,) s."""
    rim = plant.tank(sensor.tank).height
    levels = (readings - sensor.offset) / sensor.gain
    if not len(levels):
        return
    low, high = float(levels.min()), float(levels.max())
    near = levels >= (1 - RIM_MARGIN) * rim
    if high > 10 * rim or high < SMALL_SHARE * rim:
        text = f"highest level {_level(high, sensor)}, rim {_level(rim, sensor)}: a wrong unit, or empty throughout?"
        yield ChannelFinding("unit", sensor.column, text, {"high": high, "rim": rim})
    elif denied:
        numbers = {"high": denied.highest, "rim": rim, "count": denied.count}
        yield ChannelFinding("range", sensor.column, denied.text.partition(": ")[2], numbers)
    elif high > (1 + RIM_MARGIN) * rim:
        above = int((levels > (1 + RIM_MARGIN) * rim).sum())
        text = f"{above} readings lie above the rim of {sensor.tank} ({_level(high, sensor)} of {_level(rim, sensor)})"
        yield ChannelFinding("range", sensor.column, text, {"high": high, "rim": rim, "count": above})
    elif bool(near.any()):
        start, stop, count = float(time[near][0]), float(time[near][-1]), int(near.sum())
        text = (
            f"within {100 * RIM_MARGIN:.0f} % of the rim of {sensor.tank} ({_level(rim, sensor)}) in {count} samples "
            f"between {start:g} s and {stop:g} s: water may overflow there"
        )
        yield ChannelFinding("rim", sensor.column, text, {"rim": rim, "start": start, "stop": stop, "count": count})
    if low < -RIM_MARGIN * rim:
        below = int((levels < -RIM_MARGIN * rim).sum())
        text = f"{below} readings lie below the floor of {sensor.tank}, down to {_level(low, sensor)}: an offset?"
        yield ChannelFinding("range", sensor.column, text, {"low": low, "count": below})


def _level(value: float, sensor: Sensor) -> str:
    """A level (given in m) as text, in the unit in which the sensor reads levels."""
    return quantity_text(value, "m", name=sensor.column)


def _pump_findings(pump: MeteredFlow, command: Tensor) -> Iterator[ChannelFinding]:
    flow = pump.gain * command[torch.isfinite(command)]
    if not len(flow):
        return
    low, high = float(flow.min()), float(flow.max())
    lowest, highest, limit = (quantity_text(each, "m^3/s", name=pump.channel) for each in (low, high, pump.max_flow))
    if high > EXCESSIVE * pump.max_flow or 0 < high < SMALL_SHARE * pump.max_flow:
        text = f"its highest flow is {highest} of {limit}: is its unit right?"
        yield ChannelFinding("unit", pump.channel, text, {"high": high, "limit": pump.max_flow})
    elif high > (1 + 1e-6) * pump.max_flow:
        text = f"asks for up to {highest} of {pump.name}, which delivers {limit} at most"
        yield ChannelFinding("range", pump.channel, text, {"high": high, "limit": pump.max_flow})
    if low < 0:
        text = f"asks for a negative flow of {pump.name}, down to {lowest}: it delivers none"
        yield ChannelFinding("range", pump.channel, text, {"low": low})


def _valve_findings(valve: str, opening: Tensor) -> Iterator[ChannelFinding]:
    finite = opening[torch.isfinite(opening)]
    if len(finite) and (float(finite.max()) > 1 + RIM_MARGIN or float(finite.min()) < -RIM_MARGIN):
        low, high = float(finite.min()), float(finite.max())
        least, most = (significant(100.0 * opening, 3) for opening in (low, high))
        text = f"opens from {least} % to {most} %, where 100 % is fully open: is its unit right (pct)?"
        yield ChannelFinding("unit", valve, text, {"low": low, "high": high})
