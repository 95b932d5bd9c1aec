"""Readings of one plant as a monitor takes them: sample after sample, many recordings side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Hold, Recording


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
