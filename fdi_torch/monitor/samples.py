"""Readings of one plant as a monitor takes them: sample after sample, many recordings side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Hold, Recording

GAP = 10.0  # sampling intervals without a sample before the observer starts afresh
USUAL = 0.75
"""Share of the intervals no longer than the usual one: where they are random, ten medians come by chance."""


@dataclass(frozen=True)
class Samples:
    """Recordings of one plant on a common clock, channels in the plant's order.

    time (S,) s; inputs (*batch, S, channels) or (S, channels) shared by all, SI; readings (*batch, S, sensors), NaN
    where missing. hold: how inputs run between samples.
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

    def stretch(self, first: int, last: int) -> Samples:
        """Samples first..last-1, with the same clock."""
        part = slice(first, last)
        return replace(
            self, time=self.time[part], inputs=self.inputs[..., part, :], readings=self.readings[..., part, :]
        )

    def input_at(self, k: int, share: float = 0.0) -> Tensor:
        """The inputs at `share` (0..1) of the interval from sample k to the next, (*batch, channels)."""
        left = self.inputs[..., k, :]
        if self.hold == "zero_order" or share == 0.0 or k + 1 == len(self):
            return left
        return left + share * (self.inputs[..., k + 1, :] - left)


def take(recording: Recording, plant: PlantDescription) -> Samples:
    """One recording as samples without batch. Raises ValueError for a channel that lacks."""
    inputs = recording.inputs[:, _columns(recording, plant.channels(), recording.input_names, "an input")]
    sensors = tuple(sensor.column for sensor in plant.sensors)
    columns = _columns(recording, sensors, recording.output_names, "readings of")
    readings = torch.where(recording.mask[:, columns], recording.outputs[:, columns], torch.nan)
    return Samples(recording.time, inputs, readings, recording.hold)


def stack(recordings: Sequence[Recording], plant: PlantDescription) -> Samples:
    """Recordings on the same clock as one batch. Raises ValueError where the clocks differ."""
    parts = [take(recording, plant) for recording in recordings]
    if not parts:
        raise ValueError("expected at least one recording, got none")
    for recording, part in zip(recordings, parts, strict=True):
        if len(part) != len(parts[0]) or not torch.equal(part.time, parts[0].time):
            raise ValueError(
                f"expected recordings on one clock, got {recording.source} on another than {recordings[0].source}; "
                "monitor them one by one"
            )
    inputs, readings = torch.stack([p.inputs for p in parts]), torch.stack([p.readings for p in parts])
    return Samples(parts[0].time, inputs, readings, parts[0].hold)


def _columns(recording: Recording, wanted: Sequence[str], known: tuple[str, ...], kind: str) -> list[int]:
    for name in wanted:
        if name not in known:
            raise ValueError(
                f"{recording.source}: expected {kind} '{name}', got {', '.join(known) or 'none'}; map the column to it"
            )
    return [known.index(name) for name in wanted]


def usual_interval(time: Tensor) -> float:
    """Of a clock (S,), s."""
    steps = torch.diff(time)
    return float(steps[steps > 0].quantile(USUAL, interpolation="lower")) if bool((steps > 0).any()) else 1.0


@dataclass(frozen=True)
class Arrived:
    """How far the clock has come. last: of the last sample, s. unknown_since: since when an input is unknown, s."""

    last: float
    unknown_since: float | None = None


def continuous(arrived: Arrived, samples: Samples, usual: float) -> tuple[list[tuple[Samples, str]], Arrived]:
    """The new samples in stretches without a gap, a jump of the clock or unknown inputs, each with a sentence on what
    lies before it, empty where nothing does; and how far the clock is then. A sample that repeats the last one's time
    is left out.

    usual: interval between samples, s, known beforehand: that of samples yet to come would let events depend on them.
    """
    known = torch.isfinite(samples.inputs).all(dim=-1)
    stretches: list[tuple[list[int], str]] = [([], "")]
    last, unknown_since = arrived.last, arrived.unknown_since
    for k, time in enumerate(samples.time.tolist()):
        if time == last:
            continue
        if not bool(known[k]):
            unknown_since = time if unknown_since is None else unknown_since
            last = time
            continue
        notice = _notice(last, time, usual, unknown_since)
        if notice:
            stretches.append(([], notice))
        stretches[-1][0].append(k)
        last, unknown_since = time, None
    told = [(_chosen(samples, kept), notice) for kept, notice in stretches if kept]
    return told, Arrived(last, unknown_since)


def _notice(last: float, time: float, usual: float, unknown_since: float | None) -> str:
    if time < last:
        return f"the clock jumps back by {last - time:g} s; the observer starts afresh on the new time"
    if unknown_since is not None:
        return f"an input is unknown from {unknown_since:g} s to {time:g} s; the observer starts afresh"
    if time - last > GAP * usual:
        return f"no samples for {time - last:g} s; the observer starts afresh"
    return ""


def _chosen(samples: Samples, rows: Sequence[int]) -> Samples:
    index = torch.tensor(list(rows))
    return Samples(samples.time[index], samples.inputs[index], samples.readings[index], samples.hold)


def joined(first: Samples, second: Samples) -> Samples:
    """Samples of one clock, one after the other; how inputs run is as in the second."""
    return Samples(
        torch.cat([first.time, second.time]),
        torch.cat([first.inputs, second.inputs]),
        torch.cat([first.readings, second.readings]),
        second.hold,
    )
