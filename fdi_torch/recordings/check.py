"""Checks of a recording before anything is fitted to it: its clock, its inputs, and each of its channels.

A finding is a sentence with the numbers behind it, in SI. Nothing here judges a fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.names import counted
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording, runs_of
from fdi_torch.recordings.input_sampling import undersampled_inputs
from fdi_torch.recordings.plant_limits import ChannelFinding, plant_findings
from fdi_torch.recordings.repeated_readings import resolution
from fdi_torch.recordings.sensor_findings import irregular, reading_findings
from fdi_torch.tables import Table, in_display_unit

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

    def table(self) -> Table:
        """One row per channel, in its unit for display."""
        rows = []
        for c in self.channels:
            unit, *numbers = in_display_unit(c.name, c.unit, c.low, c.high, c.mean, c.resolution)
            rows.append([c.name, c.role, "share" if unit == "1" else unit, *numbers, c.missing, c.masked])
        measured = ("lowest", "highest", "mean", "smallest step", "missing", "masked")
        return Table(("channel", "", "unit", *measured), rows, digits=5)


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
            *plant_findings(recording, plant),
        ),
    )


def data_warnings(recording: Recording, plant: PlantDescription) -> list[str]:
    """Findings that limit the trust in an estimate or a verdict from the recording, one sentence each."""
    return [f"{f.channel}: {f.text}" for f in check_recording(recording, plant).findings if f.kind in DOUBTS]


def doubts_about(recordings: Sequence[Recording], plant: PlantDescription) -> tuple[str, ...]:
    """Corrections by the readers of the files, and findings that limit the trust in what is computed from them."""
    notes = [note for recording in recordings for note in recording.notes]
    return tuple(dict.fromkeys([*notes, *(s for recording in recordings for s in data_warnings(recording, plant))]))


def _summaries(recording: Recording) -> Iterator[ChannelSummary]:
    r, masked = recording, torch.isfinite(recording.outputs) & ~recording.mask
    inputs = zip(r.input_names, r.input_units, r.inputs.T, [0] * len(r.input_names), strict=True)
    outputs = zip(r.output_names, r.output_units, r.outputs.T, masked.sum(dim=0).tolist(), strict=True)
    for role, channels in (("input", inputs), ("output", outputs)):
        for name, unit, values, ignored in channels:
            known = values[torch.isfinite(values)]
            low, high, mean = (
                float(f(known)) if len(known) else math.nan for f in (torch.amin, torch.amax, torch.mean)
            )
            step, missing = resolution(known), len(values) - len(known)
            yield ChannelSummary(name, role, unit, low, high, mean, step, missing, ignored)


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
        runs = runs_of(unknown)
        if len(runs) > MANY_RUNS:
            text = (
                f"unknown at {int(unknown.sum())} of {len(values)} samples, in {len(runs)} stretches: the recording is "
                f"cut at each; {_how_held(name, torch.diff(recording.time[~unknown]))}"
            )
            yield ChannelFinding("unknown", name, text, {"count": int(unknown.sum()), "stretches": len(runs)})
            continue
        for first, after in runs:
            start, stop = float(recording.time[first]), float(recording.time[after - 1])
            samples = counted(after - first, "sample")
            text = f"unknown from {start:g} s to {stop:g} s ({samples}): the recording is cut there"
            yield ChannelFinding("unknown", name, text, {"start": start, "stop": stop})


def _how_held(name: str, intervals: Tensor) -> str:
    """How to say that an input keeps its value over empty cells. intervals: between its values, s."""
    if len(intervals) > 1 and irregular(intervals):
        return (
            "its values come at irregular times, as of a command that is recorded on change; if it is, each holds "
            f"until the next: columns: {{{name}: {{held: always}}}}"
        )
    time = GAP_STEPS * float(intervals.median()) if len(intervals) else 0.0
    return f"where an empty cell means the last value, say for how long: columns: {{{name}: {{held: {time:.3g} s}}}}"


def _missing_readings(recording: Recording) -> Iterator[ChannelFinding]:
    for name, values in zip(recording.output_names, recording.outputs.T, strict=True):
        missing = int(torch.isnan(values).sum())
        if missing:
            text = f"{missing} of {len(values)} readings are missing: they do not count"
            yield ChannelFinding("missing", name, text, {"count": missing})
