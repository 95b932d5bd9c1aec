"""What a recording is like before anything is fitted to it: its clock, and what is odd about each channel.

Nothing here judges a fit. A finding is a sentence with the numbers behind it, in SI, and a unit for them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.parameters import display_unit
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.recordings.against_plant import against_plant
from fdi_torch.recordings.finding import Finding

MANY_RUNS = 5
"""So many stretches without an input are told in one sentence."""
HOUR = 3600.0  # s
GAP_STEPS = 3.0
"""A gap is a step longer than this many usual ones."""
JITTER_SHARE = 0.05
FROZEN_SAMPLES = 20
ODD_SHARE, FEWEST_STEPS, ALIKE, IRREGULAR, FINER = 0.1, 40, 2.0, 3.0, 5.0
"""Logged on change: all steps but a tenth are at least one that is not far below the usual one and far above the
resolution, and the times between them differ by more than a factor of three.
"""
CLIPPED_SAMPLES = 5
CLIPPED_PILE = 5.0
"""Clipped: the extreme value occurs this many times as often as its neighbour."""
TWO_SAMPLES_A_HOLD = 0.5
"""Correlation of successive samples of a command that is held for two of them: 1 - (sampling interval) / (hold)."""
CERTAIN = 1.96
"""Standard errors on one side of 97.5 % of a normal distribution."""
NORMAL_MEDIAN = 0.6745
"""Of the size of a standard normal number."""
DOUBTS = ("clock", "constant", "range", "unit", "undersampled", "on change")
COARSE_SHARE = 0.5
"""Rounded coarsely: more than this share of the readings equal the one before."""


@dataclass(frozen=True)
class ChannelSummary:
    """One channel in its SI unit. resolution: the smallest step between two different values (0 where constant)."""

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
    """samples, duration (s), interval: the usual sampling interval (s), and what was found."""

    source: str
    samples: int
    duration: float
    interval: float
    channels: tuple[ChannelSummary, ...]
    findings: tuple[Finding, ...]


def check_recording(recording: Recording, plant: PlantDescription) -> RecordingCheck:
    """Clock, missing and unknown stretches, and each channel by itself and against the plant."""
    read = recording.time[torch.isfinite(recording.outputs).any(dim=1)]
    time = read if len(read) > 1 else recording.time  # rows with an input alone are no samples
    steps = torch.diff(time)
    interval = recording.interval
    return RecordingCheck(
        source=recording.source,
        samples=len(recording),
        duration=float(recording.time[-1] - recording.time[0]) if len(recording) else 0.0,
        interval=interval,
        channels=tuple(_summaries(recording)),
        findings=(
            *(Finding("read", "t", note) for note in recording.notes),
            *_clock_findings(time, steps, interval),
            *_unknown_inputs(recording),
            *_undersampled_inputs(recording, plant),
            *_missing_readings(recording),
            *_reading_findings(recording),
            *against_plant(recording, plant),
        ),
    )


def doubts(recording: Recording, plant: PlantDescription) -> list[str]:
    """What an estimate or a verdict from a recording has to be read beside, a sentence each."""
    return [f"{f.channel}: {f.text}" for f in check_recording(recording, plant).findings if f.kind in DOUBTS]


def _summaries(recording: Recording) -> Iterator[ChannelSummary]:
    for name, unit, values in zip(recording.input_names, recording.input_units, recording.inputs.T, strict=True):
        yield _summary(name, "input", unit, values, 0)
    readings = zip(recording.output_names, recording.output_units, recording.outputs.T, recording.mask.T, strict=True)
    for name, unit, values, mask in readings:
        yield _summary(name, "output", unit, values, int((torch.isfinite(values) & ~mask).sum()))


def _summary(name: str, role: str, unit: str, values: Tensor, masked: int) -> ChannelSummary:
    known = values[torch.isfinite(values)]
    missing = len(values) - len(known)
    if not len(known):
        nan = float("nan")
        return ChannelSummary(name, role, unit, nan, nan, nan, 0.0, missing, masked)
    low, high, mean = (float(f) for f in (known.min(), known.max(), known.mean()))
    return ChannelSummary(name, role, unit, low, high, mean, resolution(known), missing, masked)


def resolution(values: Tensor) -> float:
    """The smallest step between two different values, rounding of the file apart; 0 for a constant."""
    steps = torch.diff(values.unique())
    steps = steps[steps > 1e-9 * float(values.abs().max())]
    return float(steps.min()) if len(steps) else 0.0


def _clock_findings(time: Tensor, steps: Tensor, interval: float) -> Iterator[Finding]:
    jump = ((steps - HOUR).abs() <= GAP_STEPS * interval).nonzero().flatten()
    if len(jump):
        text = (
            f"jumps by an hour after {float(time[jump[0]]):g} s: where this is local time and summer time begins, say "
            "in which zone, as in columns: {t: {zone: Europe/Berlin}}"
        )
        yield Finding("clock", "t", text, {"after": float(time[jump[0]])})
    gaps = (steps > GAP_STEPS * interval).nonzero().flatten()
    if len(gaps):
        longest = int(gaps[steps[gaps].argmax()])
        text = (
            f"{len(gaps)} gaps longer than {GAP_STEPS:g} sampling intervals ({interval:g} s), the longest of "
            f"{float(steps[longest]):g} s after {float(time[longest]):g} s"
        )
        yield Finding("gap", "t", text, {"count": len(gaps), "longest": float(steps[longest])})
    usual = steps[steps <= GAP_STEPS * interval]
    jitter = float((usual - interval).abs().max()) if len(usual) else 0.0
    if jitter > JITTER_SHARE * interval:
        text = f"the sampling interval of {interval:g} s varies by up to {jitter:.3g} s"
        yield Finding("clock", "t", text, {"interval": interval, "jitter": jitter})


def _unknown_inputs(recording: Recording) -> Iterator[Finding]:
    for name, values in zip(recording.input_names, recording.inputs.T, strict=True):
        unknown = torch.isnan(values)
        runs = _runs(unknown)
        if len(runs) > MANY_RUNS:
            text = (
                f"unknown at {int(unknown.sum())} of {len(values)} samples, in {len(runs)} stretches: the recording is "
                f"cut at each; where an empty cell means the last value, say for how long: columns: "
                f"{{{name}: {{held: {_usual_step(recording.time[~unknown]):.3g} s}}}}"
            )
            yield Finding("unknown", name, text, {"count": int(unknown.sum()), "stretches": len(runs)})
            continue
        for first, last in runs:
            start, stop = float(recording.time[first]), float(recording.time[last])
            text = f"unknown from {start:g} s to {stop:g} s ({last - first + 1} samples): the recording is cut there"
            yield Finding("unknown", name, text, {"start": start, "stop": stop})


def _undersampled_inputs(recording: Recording, plant: PlantDescription) -> Iterator[Finding]:
    """Pump commands that are, at 97.5 %, held for less than two samples on average, or swing faster than six a period,
    so strongly that the unknown flow of one interval moves the level by more than its readings scatter.

    Of a command that switches at random and is held for a time h, samples at intervals d <= h correlate by 1 - d / h,
    and those of a sine of period T by cos(2 pi d / T); 1 / sqrt(N) is the standard error over N samples that are
    independent of each other.
    """
    for pump in plant.pumps:
        areas = [tank.area for tank in plant.tanks if tank.name == pump.target]
        if pump.channel not in recording.input_names or not areas:
            continue
        name, values = pump.channel, recording.inputs[:, recording.input_names.index(pump.channel)]
        known = torch.isfinite(values[:-1]) & torch.isfinite(values[1:])
        before, after = values[:-1][known], values[1:][known]
        variance = float(torch.cat([before, after]).var(correction=0)) if len(before) else 0.0
        unknown = pump.gain * variance**0.5 * recording.interval / areas[0]
        if not unknown > _scatter(recording, plant, pump.target):
            continue
        share = 1.0 - float((after - before).square().mean()) / (2.0 * variance)
        if share + CERTAIN / len(before) ** 0.5 < TWO_SAMPLES_A_HOLD:
            text = (
                f"moves about as fast as it is sampled: successive samples correlate by {share:.2f}, those of a "
                f"command that is held for two samples by {TWO_SAMPLES_A_HOLD:g}. What it does between samples is not "
                "recorded; unless it is held from each sample to the next, its flow is unknown and the error looks "
                "like an effect of the pump: log it faster, or its mean over each interval"
            )
            yield Finding("undersampled", name, text, {"correlation": share, "interval": recording.interval})


def _scatter(recording: Recording, plant: PlantDescription, tank: str) -> float:
    """The least that readings of a tank's level scatter or step by, as a level, m; infinite where no sensor sees it."""
    found = [torch.inf]
    for sensor in plant.sensors:
        if sensor.tank == tank and sensor.column in recording.output_names:
            column = recording.output_names.index(sensor.column)
            values = recording.outputs[recording.mask[:, column], column] / sensor.gain
            if len(values) > 2:  # second differences of white noise of unit size are normal, with a variance of 6
                scatter = float(torch.diff(values, n=2).abs().median()) / (NORMAL_MEDIAN * 6.0**0.5)
                found.append(max(scatter, resolution(values)))
    return min(found)


def _usual_step(time: Tensor) -> float:
    return float(torch.diff(time).median()) if len(time) > 1 else 0.0


def _missing_readings(recording: Recording) -> Iterator[Finding]:
    for name, values in zip(recording.output_names, recording.outputs.T, strict=True):
        missing = int(torch.isnan(values).sum())
        if missing:
            text = f"{missing} of {len(values)} readings are missing: they do not count"
            yield Finding("missing", name, text, {"count": missing})


def _reading_findings(recording: Recording) -> Iterator[Finding]:
    for i, (name, unit) in enumerate(zip(recording.output_names, recording.output_units, strict=True)):
        mask = recording.mask[:, i]
        values = recording.outputs[mask, i]
        if len(values) < 2:
            continue
        if bool((values == values[0]).all()):
            text = f"constant at {_shown(values[0], unit)}: its correlation with anything is undefined"
            yield Finding("constant", name, text, {"value": float(values[0])})
            continue
        yield from _on_change(name, values, recording.time[mask], unit)
        yield from _clipped(name, values, unit)
        yield from _frozen(name, values, recording.time[mask])
        yield from _quantised(name, values, unit)


def _on_change(name: str, values: Tensor, time: Tensor, unit: str) -> Iterator[Finding]:
    """Logged where it has moved by a least step: readings that follow each other hardly ever lie closer."""
    steps, waits = torch.diff(values).abs(), torch.diff(time)
    least = float(steps.quantile(ODD_SHARE)) if len(steps) >= FEWEST_STEPS else 0.0
    usual = float(steps.median())
    irregular = float(waits.quantile(0.9)) > IRREGULAR * float(waits.quantile(0.1))
    if irregular and least > 0.0 and usual < ALIKE * least and least > FINER * resolution(values):
        text = (
            f"seems to be logged on change, when it has moved by {_shown(least, unit)}: readings come early or late by "
            "as much, which standard errors do not know; where exactness matters log at a fixed rate"
        )
        yield Finding("on change", name, text, {"step": least})


def _clipped(name: str, values: Tensor, unit: str) -> Iterator[Finding]:
    """An extreme value that is read again and again, much more often than the value next to it."""
    distinct, counts = values.unique(return_counts=True)
    for side, end, neighbour in (("lowest", 0, 1), ("highest", -1, -2)):
        times = int(counts[end])
        if times >= CLIPPED_SAMPLES and times >= CLIPPED_PILE * int(counts[neighbour]):
            value = float(distinct[end])
            text = f"the {side} value {_shown(value, unit)} was read {times} times: clipped there, or at rest"
            yield Finding("clipped", name, text, {"value": value, "count": times})


def _frozen(name: str, values: Tensor, time: Tensor) -> Iterator[Finding]:
    """A value that repeats far longer than its readings usually do."""
    lengths, ends = _repeats(values)
    longest = int(lengths.argmax())
    usual = float(lengths.double().mean())
    if int(lengths[longest]) >= FROZEN_SAMPLES * usual:
        count, last = int(lengths[longest]), int(ends[longest])
        start, stop = float(time[last - count + 1]), float(time[last])
        text = f"did not change for {count} samples, from {start:g} s to {stop:g} s (usually for {usual:.2g})"
        yield Finding("frozen", name, text, {"start": start, "stop": stop, "count": count})


def _quantised(name: str, values: Tensor, unit: str) -> Iterator[Finding]:
    """Readings move in steps so coarse that most do not differ from the one before."""
    same = float((torch.diff(values) == 0).double().mean())
    step = resolution(values)
    if same > COARSE_SHARE:
        text = (
            f"moves in steps of {_shown(step, unit)} and stays on one for {same:.0%} of the samples: rounded coarsely"
        )
        yield Finding("quantised", name, text, {"step": step, "share": same})


def _shown(value: Tensor | float, unit: str) -> str:
    label, scale = ("%", 100.0) if unit == "1" else display_unit(unit)
    return f"{scale * float(value):.4g} {label}"


def _runs(flags: Tensor) -> list[tuple[int, int]]:
    """First and last index of each stretch of True."""
    padded = flags.to(torch.int8)
    edges = torch.diff(padded, prepend=padded.new_zeros(1), append=padded.new_zeros(1)).nonzero().flatten().tolist()
    return [(first, after - 1) for first, after in zip(edges[::2], edges[1::2], strict=True)]


def _repeats(values: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths of the runs of equal values, and the index at which each ends."""
    _, lengths = torch.unique_consecutive(values, return_counts=True)
    return lengths, torch.cumsum(lengths, 0) - 1
