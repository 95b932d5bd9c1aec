"""Checks of a recording's channels against the plant: units, rims, and limits of pumps and valves."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.metered_flow import MeteredFlow
from fdi_torch.quantities import quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.channel_finding import ChannelFinding

RIM_MARGIN = 0.02
SMALL_SHARE = 0.01
"""The unit is suspect if all values are below this share of the limit, or any is above ten times the limit."""


def plant_limit_findings(recording: Recording, plant: PlantDescription) -> Iterator[ChannelFinding]:
    """Findings of all sensors, pumps, transfers and valves that the recording has."""
    for sensor in plant.sensors:
        if sensor.column in recording.output_names:
            column = recording.output_names.index(sensor.column)
            valid = recording.mask[:, column]
            yield from _level_findings(sensor, plant, recording.outputs[valid, column], recording.time[valid])
    for pump in plant.metered_flows():
        if pump.channel in recording.input_names:
            yield from _pump_findings(pump, recording.inputs[:, recording.input_names.index(pump.channel)])
    for valve in dict.fromkeys(pipe.valve for pipe in plant.pipes if pipe.valve):
        if valve in recording.input_names:
            yield from _valve_findings(valve, recording.inputs[:, recording.input_names.index(valve)])


def _level_findings(
    sensor: Sensor, plant: PlantDescription, readings: Tensor, time: Tensor
) -> Iterator[ChannelFinding]:
    """Findings about the valid readings (K,) of a sensor at the times (K,) s."""
    rim = plant.tank(sensor.tank).height
    levels = (readings - sensor.offset) / sensor.gain
    if not len(levels):
        return
    low, high = float(levels.min()), float(levels.max())
    near = levels >= (1 - RIM_MARGIN) * rim
    if high > 10 * rim or high < SMALL_SHARE * rim:
        text = f"highest level {_level(high)}, rim {_level(rim)}: a wrong unit, or empty throughout?"
        yield ChannelFinding("unit", sensor.column, text, {"high": high, "rim": rim})
    elif high > (1 + RIM_MARGIN) * rim:
        above = int((levels > (1 + RIM_MARGIN) * rim).sum())
        text = f"{above} readings lie above the rim of {sensor.tank} ({_level(high)} of {_level(rim)})"
        yield ChannelFinding("range", sensor.column, text, {"high": high, "rim": rim, "count": above})
    elif bool(near.any()):
        start, stop, count = float(time[near][0]), float(time[near][-1]), int(near.sum())
        text = (
            f"within {100 * RIM_MARGIN:.0f} % of the rim of {sensor.tank} ({_level(rim)}) in {count} samples between "
            f"{start:g} s and {stop:g} s: water may overflow there"
        )
        yield ChannelFinding("rim", sensor.column, text, {"rim": rim, "start": start, "stop": stop, "count": count})
    if low < -RIM_MARGIN * rim:
        below = int((levels < -RIM_MARGIN * rim).sum())
        text = f"{below} readings lie below the floor of {sensor.tank}, down to {_level(low)}: an offset?"
        yield ChannelFinding("range", sensor.column, text, {"low": low, "count": below})


def _level(value: float) -> str:
    return quantity_text(value, "m")


def _pump_findings(pump: MeteredFlow, command: Tensor) -> Iterator[ChannelFinding]:
    flow = pump.gain * command[torch.isfinite(command)]
    if not len(flow):
        return
    low, high = float(flow.min()), float(flow.max())
    lowest, highest, limit = (quantity_text(each, "m^3/s") for each in (low, high, pump.max_flow))
    if high > 10 * pump.max_flow or 0 < high < SMALL_SHARE * pump.max_flow:
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
        text = f"opens from {low:.3g} to {high:.3g} where 0 is closed and 1 is open: is its unit right (pct)?"
        yield ChannelFinding("unit", valve, text, {"low": low, "high": high})
