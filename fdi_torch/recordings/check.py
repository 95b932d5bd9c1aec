"""Checks of a recording before anything is fitted to it: its clock, its inputs, and each of its channels.

A finding is a sentence with the numbers behind it, in SI. Nothing here judges a fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.names import counted
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.input_sampling import undersampled_inputs
from fdi_torch.recordings.plant_limits import ChannelFinding, plant_limit_findings
from fdi_torch.recordings.plant_units import doubtful_units
from fdi_torch.recordings.repeated_readings import resolution

MANY_RUNS = 5
"""More segments without an input than this are reported in one sentence."""
HOUR = 3600.0  # s
GAP_STEPS = 3.0
"""A gap is a sampling interval longer than this many usual ones."""
JITTER_SHARE = 0.05
DOUBTS = ("clock", "constant", "held", "range", "unit", "undersampled", "on change")


@dataclass(frozen=True)
class ChannelSummary:
    """One channel in its SI unit. resolution: smallest difference of two distinct values (0 for a constant channel)."""

    name: str
    role: str
    unit: str
    low: float
    high: float
    mean: float
    resolution: float
    missing: int
    masked: int


@dataclass(frozen=True)
class RecordingCheck:
    """The summary and the findings of a recording. duration in s; interval: the usual sampling interval, s."""

    source: str
    samples: int
    duration: float
    interval: float
    channels: tuple[ChannelSummary, ...]
    findings: tuple[ChannelFinding, ...]


def check_recording(recording: Recording, plant: PlantDescription) -> RecordingCheck:
    """Check the clock, missing data, and each channel by itself and against the plant."""
    read = recording.time[torch.isfinite(recording.outputs).any(dim=1)]
    time = read if len(read) > 1 else recording.time  # rows with inputs only are not samples
    steps = torch.diff(time)
    interval = recording.interval
    return RecordingCheck(
        source=recording.source,
        samples=len(recording),
        duration=float(recording.time[-1] - recording.time[0]) if len(recording) else 0.0,
        interval=interval,
        channels=tuple(_summaries(recording)),
        findings=(
            *(ChannelFinding("read", "t", note) for note in recording.notes),
            *_clock_findings(time, steps, interval),
            *_changes_in_gaps(recording),
            *_missing_inputs(recording),
            *_constant_inputs(recording),
            *undersampled_inputs(recording, plant),
            *_missing_readings(recording),
            *reading_findings(recording),
            *_against_the_plant(recording, plant),
        ),
    )


def _against_the_plant(recording: Recording, plant: PlantDescription) -> list[ChannelFinding]:
    """Findings by the plant's limits and, where these call no unit wrong, by the volume balance of its tanks."""
    findings = list(plant_limit_findings(recording, plant))
    settled = recording.trusted or any(finding.kind == "unit" for finding in findings)
    doubts = [] if settled else doubtful_units(plant, recording)
    return findings + [ChannelFinding("unit", columns, text) for columns, text in doubts]


def data_warnings(recording: Recording, plant: PlantDescription) -> list[str]:
    """Findings that limit the trust in an estimate or a verdict from the recording, one sentence each."""
    return [f"{f.channel}: {f.text}" for f in check_recording(recording, plant).findings if f.kind in DOUBTS]


def _summaries(recording: Recording) -> Iterator[ChannelSummary]:
    for name, unit, values in zip(recording.input_names, recording.input_units, recording.inputs.T, strict=True):
        yield _summary(name, "input", unit, values, 0)
    readings = zip(recording.output_names, recording.output_units, recording.outputs.T, recording.mask.T, strict=True)
    for name, unit, values, mask in readings:
        yield _summary(name, "output", unit, values, int((torch.isfinite(values) & ~mask).sum()))


def _summary(name: str, role: str, unit: str, values: Tensor, masked: int) -> ChannelSummary:
    finite = values[torch.isfinite(values)]
    missing = len(values) - len(finite)
    if not len(finite):
        nan = float("nan")
        return ChannelSummary(name, role, unit, nan, nan, nan, 0.0, missing, masked)
    low, high, mean = (float(f) for f in (finite.min(), finite.max(), finite.mean()))
    return ChannelSummary(name, role, unit, low, high, mean, resolution(finite), missing, masked)


def _clock_findings(time: Tensor, steps: Tensor, interval: float) -> Iterator[ChannelFinding]:
    jump = _jumps_by_an_hour(steps, interval).nonzero().flatten()
    if len(jump):
        text = (
            f"jumps by an hour after {float(time[jump[0]]):g} s: where this is local time and summer time begins, say "
            "in which zone, as in columns: {t: {zone: Europe/Berlin}}"
        )
        yield ChannelFinding("clock", "t", text, {"after": float(time[jump[0]])})
    gaps = (steps > GAP_STEPS * interval).nonzero().flatten()
    if len(gaps):
        longest = int(gaps[steps[gaps].argmax()])
        text = (
            f"{counted(len(gaps), 'gap')} longer than {GAP_STEPS:g} sampling intervals ({interval:g} s), the longest "
            f"of {float(steps[longest]):g} s after {float(time[longest]):g} s"
        )
        yield ChannelFinding("gap", "t", text, {"count": len(gaps), "longest": float(steps[longest])})
    usual = steps[steps <= GAP_STEPS * interval]
    jitter = float((usual - interval).abs().max()) if len(usual) else 0.0
    if jitter > JITTER_SHARE * interval:
        text = f"the sampling interval of {interval:g} s varies by up to {jitter:.3g} s"
        yield ChannelFinding("clock", "t", text, {"interval": interval, "jitter": jitter})


def _jumps_by_an_hour(steps: Tensor, interval: float) -> Tensor:
    """Which steps of the time, s, may be due to the beginning of summer time."""
    return (steps - HOUR).abs() <= GAP_STEPS * interval


def _changes_in_gaps(recording: Recording) -> Iterator[ChannelFinding]:
    """Held inputs that change while rows are missing."""
    steps, interval = torch.diff(recording.time), recording.interval
    gap = (steps > GAP_STEPS * interval) & ~_jumps_by_an_hour(steps, interval)
    if recording.hold != "zero_order":
        return
    for name, values in zip(recording.input_names, recording.inputs.T, strict=True):
        change = torch.diff(values)
        moved = (gap & torch.isfinite(change) & (change != 0.0)).nonzero().flatten()
        if len(moved):
            start = float(recording.time[moved[0]])
            text = (
                f"changes in the gap after {start:g} s, at an unknown time; it counts as unchanged until the gap ends, "
                f"unless the recording is cut there: by columns: {{{name}: {{held: {GAP_STEPS * interval:g} s}}}} if "
                "it is recorded at every sample, by stop and start of two entries if it is recorded on change"
            )
            yield ChannelFinding("held", name, text, {"after": start, "count": len(moved)})


def _constant_inputs(recording: Recording) -> Iterator[ChannelFinding]:
    """Inputs none of which ever changes."""
    known = recording.inputs[torch.isfinite(recording.inputs).all(dim=1)]
    if known.numel() and bool((known == known[0]).all()):
        names = ", ".join(recording.input_names)
        text = "no change throughout: right column? Constant inputs leave most faults indistinguishable (fdi plan)"
        yield ChannelFinding("constant input", names, text)


def _missing_inputs(recording: Recording) -> Iterator[ChannelFinding]:
    for name, values in zip(recording.input_names, recording.inputs.T, strict=True):
        unknown = torch.isnan(values)
        runs = _runs(unknown)
        if len(runs) > MANY_RUNS:
            text = (
                f"unknown at {int(unknown.sum())} of {len(values)} samples, in {len(runs)} stretches: the recording is "
                f"cut at each; {_how_held(name, torch.diff(recording.time[~unknown]))}"
            )
            yield ChannelFinding("unknown", name, text, {"count": int(unknown.sum()), "stretches": len(runs)})
            continue
        for first, last in runs:
            start, stop = float(recording.time[first]), float(recording.time[last])
            samples = counted(last - first + 1, "sample")
            text = f"unknown from {start:g} s to {stop:g} s ({samples}): the recording is cut there"
            yield ChannelFinding("unknown", name, text, {"start": start, "stop": stop})


def _how_held(name: str, intervals: Tensor) -> str:
    """How to say that an input keeps its value over empty cells. intervals: between its values, s."""
    if len(intervals) > 1 and _irregular(intervals):
        return (
            "its values come at irregular times, as of a command that is recorded on change; if it is, each holds "
            f"until the next: columns: {{{name}: {{held: always}}}}"
        )
    time = GAP_STEPS * float(intervals.median()) if len(intervals) else 0.0
    return f"where an empty cell means the last value, say for how long: columns: {{{name}: {{held: {time:.3g} s}}}}"


def _irregular(intervals: Tensor) -> bool:
    """Whether times between successive values differ so much that these are logged on change."""
    return float(intervals.quantile(0.9)) > IRREGULAR * float(intervals.quantile(0.1))


def _missing_readings(recording: Recording) -> Iterator[ChannelFinding]:
    for name, values in zip(recording.output_names, recording.outputs.T, strict=True):
        missing = int(torch.isnan(values).sum())
        if missing:
            text = f"{missing} of {len(values)} readings are missing: they do not count"
            yield ChannelFinding("missing", name, text, {"count": missing})


def _runs(flags: Tensor) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    padded = flags.to(torch.int8)
    edges = torch.diff(padded, prepend=padded.new_zeros(1), append=padded.new_zeros(1)).nonzero().flatten().tolist()
    return [(first, after - 1) for first, after in zip(edges[::2], edges[1::2], strict=True)]


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
    """Findings of all sensors of the recording."""
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
        _irregular(intervals)
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
    lengths, ends = _repeats(values)
    longest = int(lengths.argmax())
    usual = float(lengths.double().mean())
    if int(lengths[longest]) >= FROZEN_SAMPLES * usual:
        count, last = int(lengths[longest]), int(ends[longest])
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


def _repeats(values: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths of the runs of equal values, and the index at which each ends."""
    _, lengths = torch.unique_consecutive(values, return_counts=True)
    return lengths, torch.cumsum(lengths, 0) - 1
