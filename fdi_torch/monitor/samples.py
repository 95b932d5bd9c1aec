"""Samples of one plant as monitors and observers process them, optionally a batch of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Hold, Recording

GAP = 10.0  # sampling intervals without a sample after which the observer restarts
ABSENT = 100  # samples without a reading after which no level is expected from a sensor
USUAL_QUANTILE = 0.75
"""The usual interval is this quantile of the intervals; with random intervals, ten medians would occur by chance."""


@dataclass(frozen=True)
class Samples:
    """Recordings of one plant on a common clock, channels in the plant's order.

    time (S,) s; inputs (*batch, S, channels) or (S, channels) shared by all, SI; readings (*batch, S, sensors), NaN
    where missing. hold: interpolation of the inputs between samples.
    """

    time: Tensor
    inputs: Tensor
    readings: Tensor
    hold: Hold = "zero_order"

    def __len__(self) -> int:
        return len(self.time)

    @property
    def batch(self) -> torch.Size:
        return self.readings.shape[:-2]

    def segment(self, first: int, last: int) -> Samples:
        """Samples first .. last - 1."""
        part = slice(first, last)
        return replace(
            self, time=self.time[part], inputs=self.inputs[..., part, :], readings=self.readings[..., part, :]
        )

    def member(self, i: int) -> Samples:
        """One recording of a batch."""
        inputs = self.inputs[i] if self.inputs.dim() > 2 else self.inputs
        return replace(self, inputs=inputs, readings=self.readings[i])


def samples_of_recording(recording: Recording, plant: PlantDescription) -> Samples:
    """One recording as samples without a batch dimension. Raises ValueError if a channel is missing."""
    inputs = recording.inputs[:, recording.input_columns(plant.channels())]
    readings = recording.readings[:, recording.output_columns(plant.outputs())]
    return Samples(recording.time, inputs, readings, recording.hold)


def usual_interval(time: Tensor) -> float:
    """Usual interval between sample times (S,), s."""
    steps = torch.diff(time)
    return float(steps[steps > 0].quantile(USUAL_QUANTILE, interpolation="lower")) if bool((steps > 0).any()) else 1.0


def mean_interval(time: Tensor) -> float:
    """Mean interval between sample times (S,) without gaps, s: what counts per sample happens once in this time."""
    steps = torch.diff(time)
    steps = steps[(steps > 0) & (steps <= GAP * usual_interval(time))]
    return float(steps.mean()) if len(steps) else usual_interval(time)


@dataclass(frozen=True)
class Restart:
    """A restart of the observer that waits for a reading of each sensor.

    notice: why it restarts. readings (sensors,): the latest since the interruption, NaN where there is none yet.
    """

    notice: str
    readings: Tensor


@dataclass(frozen=True)
class ClockState:
    """Clock of the samples processed so far.

    last: time of the last one, s. unknown_since: when an input became unknown, s. unread (sensors,): samples since the
    last reading of each sensor. restart: the next one; None if none is due.
    """

    last: float
    unknown_since: float | None = None
    unread: Tensor | None = None
    restart: Restart | None = None


def split_at_gaps(clock: ClockState, samples: Samples, usual: float) -> tuple[list[tuple[Samples, str]], ClockState]:
    """Split new samples at gaps, jumps of the clock and unknown inputs; returns the segments and the clock after them.

    Each segment comes with a notice of the interruption before it, or an empty text. After an interruption it begins
    once each sensor has been read again, except those that were silent for ABSENT samples; its first sample has the
    latest reading of each. Repeated sample times are dropped. usual: interval between samples, s. It is given rather
    than estimated here, so that events do not depend on later samples.
    """
    inputs_known = torch.isfinite(samples.inputs).all(dim=-1)
    unread = _samples_since_reading(clock.unread, samples.readings)
    segments: list[tuple[list[int], str, Tensor | None]] = [([], "", None)]
    last, unknown_since, restart = clock.last, clock.unknown_since, clock.restart
    for k, time in enumerate(samples.time.tolist()):
        if time == last:
            continue
        if not bool(inputs_known[k]):
            unknown_since = time if unknown_since is None else unknown_since
            last = time
            continue
        notice = _notice(last, time, usual, unknown_since)
        last, unknown_since = time, None
        if notice:
            earlier = [restart.notice] if restart is not None else []
            restart = Restart("; ".join([*earlier, notice]), torch.full_like(samples.readings[k], torch.nan))
        if restart is None:
            segments[-1][0].append(k)
            continue
        row = samples.readings[k]
        restart = replace(restart, readings=torch.where(torch.isfinite(row), row, restart.readings))
        if bool((torch.isfinite(restart.readings) | (unread[k] >= ABSENT)).all()):
            segments.append(([k], restart.notice, restart.readings))
            restart = None
    parts = [(_rows(samples, rows, first), notice) for rows, notice, first in segments if rows]
    return parts, ClockState(last, unknown_since, unread[-1] if len(unread) else clock.unread, restart)


def _samples_since_reading(before: Tensor | None, readings: Tensor) -> Tensor:
    """Samples since the last reading of each sensor, (S, sensors). before (sensors,): the same before the first one."""
    count, sensors = readings.shape
    before = torch.zeros(sensors, dtype=torch.int64) if before is None else before
    index = torch.arange(1, count + 1).unsqueeze(-1)
    latest = torch.where(torch.isfinite(readings), index, -before).cummax(0).values
    return index - latest


def _notice(last: float, time: float, usual: float, unknown_since: float | None) -> str:
    if time < last:
        return f"the clock jumps back by {last - time:g} s; the observer restarts at the new time"
    if unknown_since is not None:
        return f"an input is unknown from {unknown_since:g} s to {time:g} s; the observer restarts"
    if time - last > GAP * usual:
        return f"no samples for {time - last:g} s; the observer restarts"
    return ""


def _rows(samples: Samples, rows: Sequence[int], first: Tensor | None) -> Samples:
    """Some of the samples. first (sensors,): replaces the readings of the first one."""
    index = torch.tensor(list(rows))
    readings = samples.readings[index]
    if first is not None:
        readings[0] = first
    return Samples(samples.time[index], samples.inputs[index], readings, samples.hold)


def concatenated(first: Samples, second: Samples) -> Samples:
    """Two consecutive parts of one recording; the interpolation of inputs is that of the second."""
    return Samples(
        torch.cat([first.time, second.time]),
        torch.cat([first.inputs, second.inputs]),
        torch.cat([first.readings, second.readings]),
        second.hold,
    )
