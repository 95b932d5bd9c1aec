"""Checks of each sensor's readings by themselves: constant, logged on change, clipped, frozen or rounded coarsely."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from fdi_torch.quantities import quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.plant_limits import ChannelFinding
from fdi_torch.recordings.repeated_readings import resolution

FROZEN_SAMPLES = 20
ODD_SHARE, FEWEST_STEPS, ALIKE, IRREGULAR, FINER = 0.1, 40, 2.0, 3.0, 5.0
"""A channel is logged on change if nine in ten of its steps exceed a minimum step, and the times between them differ by
more than a factor of three. The minimum step is close to the usual one and far above the resolution.
"""
CLIPPED_SAMPLES = 5
CLIPPED_PILE = 5.0
"""Clipped: the extreme value occurs this many times as often as its neighbour."""
COARSE_SHARE = 0.5
"""Rounded coarsely: more than this share of the readings equal the one before."""


def reading_findings(recording: Recording) -> Iterator[ChannelFinding]:
    for i, (name, unit) in enumerate(zip(recording.output_names, recording.output_units, strict=True)):
        mask = recording.mask[:, i]
        values = recording.outputs[mask, i]
        if len(values) < 2:
            continue
        if bool((values == values[0]).all()):
            text = f"constant at {_shown(values[0], unit)}: its correlation with anything is undefined"
            yield ChannelFinding("constant", name, text, {"value": float(values[0])})
            continue
        yield from _on_change(name, values, recording.time[mask], unit)
        yield from _clipped(name, values, unit)
        yield from _frozen(name, values, recording.time[mask])
        yield from _quantised(name, values, unit)


def _on_change(name: str, values: Tensor, time: Tensor, unit: str) -> Iterator[ChannelFinding]:
    """Readings logged only when they have changed by a minimum step, so that successive ones are hardly ever closer."""
    steps, intervals = torch.diff(values).abs(), torch.diff(time)
    least_step = float(steps.quantile(ODD_SHARE)) if len(steps) >= FEWEST_STEPS else 0.0
    usual = float(steps.median())
    if (
        irregular(intervals)
        and least_step > 0.0
        and usual < ALIKE * least_step
        and least_step > FINER * resolution(values)
    ):
        text = (
            f"seems to be logged on change, when it has moved by {_shown(least_step, unit)}: readings come early or "
            "late by as much, which standard errors do not include; log at a fixed rate where accuracy matters"
        )
        yield ChannelFinding("on change", name, text, {"step": least_step})


def _clipped(name: str, values: Tensor, unit: str) -> Iterator[ChannelFinding]:
    """An extreme value that occurs much more often than the value next to it."""
    distinct, counts = values.unique(return_counts=True)
    for side, end, neighbour in (("lowest", 0, 1), ("highest", -1, -2)):
        times = int(counts[end])
        if times >= CLIPPED_SAMPLES and times >= CLIPPED_PILE * int(counts[neighbour]):
            value = float(distinct[end])
            text = f"the {side} value {_shown(value, unit)} was read {times} times: clipped there, or at rest"
            yield ChannelFinding("clipped", name, text, {"value": value, "count": times})


def _frozen(name: str, values: Tensor, time: Tensor) -> Iterator[ChannelFinding]:
    """A value that is repeated much longer than is usual for these readings."""
    _, lengths = torch.unique_consecutive(values, return_counts=True)
    longest = int(lengths.argmax())
    usual = float(lengths.double().mean())
    if int(lengths[longest]) >= FROZEN_SAMPLES * usual:
        count, last = int(lengths[longest]), int(lengths[: longest + 1].sum()) - 1
        start, stop = float(time[last - count + 1]), float(time[last])
        text = f"did not change for {count} samples, from {start:g} s to {stop:g} s (usually for {usual:.2g})"
        yield ChannelFinding("frozen", name, text, {"start": start, "stop": stop, "count": count})


def _quantised(name: str, values: Tensor, unit: str) -> Iterator[ChannelFinding]:
    """Readings with steps so coarse that most equal the one before."""
    same = float((torch.diff(values) == 0).double().mean())
    step = resolution(values)
    if same > COARSE_SHARE:
        moves = f"moves in steps of {_shown(step, unit)} and stays on one for {100 * same:.0f} % of the samples"
        yield ChannelFinding("quantised", name, f"{moves}: rounded coarsely", {"step": step, "share": same})


def _shown(value: Tensor | float, unit: str) -> str:
    return f"{100 * float(value):.4g} %" if unit == "1" else quantity_text(float(value), unit)


def irregular(intervals: Tensor) -> bool:
    """Whether times between successive values differ so much that these are logged on change."""
    return float(intervals.quantile(0.9)) > IRREGULAR * float(intervals.quantile(0.1))
