"""Recording: time, inputs, outputs and where they came from; the one thing rooms hand each other. All is SI."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

Hold = Literal["zero_order", "linear"]


@dataclass(frozen=True)
class Recording:
    """What was commanded and read on a rig, on its own clock.

    time (T,) in s, strictly increasing. inputs (T, M) and outputs (T, N) in the SI units named beside them.
    mask (T, N): True where a reading counts; a missing reading is NaN in outputs and False here.
    An unknown input is NaN; `known_stretches` cuts the recording there. hold: how inputs run between samples.
    began: its time 0 in seconds since 1970, where its clock tells.
    notes: what the reader did to the file's rows, in sentences.
    ran: inputs that were on, or may have been, before the first sample, as far as what it was cut from tells.
    """

    time: Tensor
    inputs: Tensor
    outputs: Tensor
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    mask: Tensor = field(default=None)  # type: ignore[assignment]
    hold: Hold = "zero_order"
    source: str = "memory"
    sha256: str = ""
    ran: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()
    began: float | None = None

    def __post_init__(self) -> None:
        if self.mask is None:
            object.__setattr__(self, "mask", torch.isfinite(self.outputs))
        samples = len(self.time)
        for name, tensor, width in (
            ("inputs", self.inputs, len(self.input_names)),
            ("outputs", self.outputs, len(self.output_names)),
            ("mask", self.mask, len(self.output_names)),
        ):
            if tuple(tensor.shape) != (samples, width):
                raise ValueError(
                    f"{self.source}: expected {name} of shape {(samples, width)}, got {tuple(tensor.shape)}"
                )
        steps = torch.diff(self.time)
        if not bool((steps > 0).all()):
            row = int((steps <= 0).nonzero()[0]) + 1
            raise ValueError(
                f"{self.source}: expected time that increases, got {float(self.time[row - 1]):g} s followed by "
                f"{float(self.time[row]):g} s in sample {row}; sort the rows or drop the repeated ones"
            )

    def __len__(self) -> int:
        return len(self.time)

    @property
    def interval(self) -> float:
        """The usual sampling interval, s: of the sensor that is read most often, by the median between its readings.

        Rows that hold another sensor's reading, or only an input, say nothing of it.
        """
        times = [self.time[column] for column in self.mask.T if int(column.sum()) > 1] or [self.time]
        return min(float(torch.median(torch.diff(each))) for each in times) if len(self) > 1 else 0.0

    def to(self, device: torch.device) -> Recording:
        """The same with its tensors on a device."""
        tensors = {name: getattr(self, name).to(device) for name in ("time", "inputs", "outputs", "mask")}
        return replace(self, **tensors)

    def stretch(self, first: int, last: int) -> Recording:
        """Samples first..last-1, with the same clock."""
        part = slice(first, last)
        on = (~(self.inputs[:first] <= 0.0)).any(dim=0).tolist()
        return replace(
            self,
            ran=self.ran | {name for name, ever in zip(self.input_names, on, strict=True) if ever},
            time=self.time[part],
            inputs=self.inputs[part],
            outputs=self.outputs[part],
            mask=self.mask[part],
        )

    def window(self, start: float = -math.inf, stop: float = math.inf) -> Recording:
        """Samples with start <= time <= stop (s), on the same clock. Raises ValueError where fewer than two are."""
        first = int((self.time < start).sum())
        last = int((self.time <= stop).sum())
        if last - first < 2:
            raise ValueError(
                f"{self.source}: expected at least two samples between start {start:g} s and stop {stop:g} s, got "
                f"{max(last - first, 0)} (the recording runs from {self.time[0]:g} s to {self.time[-1]:g} s)"
            )
        return self.stretch(first, last)

    def masked(self, intervals: Iterable[tuple[float, float]]) -> Recording:
        """Readings within start <= time <= stop (s) no longer count; the inputs stay."""
        keep = torch.ones_like(self.time, dtype=torch.bool)
        for start, stop in intervals:
            if not start < stop:
                raise ValueError(f"{self.source}: expected masks with start < stop, got [{start:g}, {stop:g}] s")
            keep &= (self.time < start) | (self.time > stop)
        return replace(self, mask=self.mask & keep[:, None])

    def every(self, step: int) -> Recording:
        """Every step-th sample. A held input becomes its mean until the next kept sample, so that no volume is lost.

        An input of which any part is unknown becomes unknown (NaN).
        """
        if step < 1:
            raise ValueError(f"{self.source}: expected every to be a whole number from 1, got {step}")
        if step == 1:
            return self
        inputs = self._held_means(step) if self.hold == "zero_order" else self.inputs[::step]
        return replace(
            self, time=self.time[::step], inputs=inputs, outputs=self.outputs[::step], mask=self.mask[::step]
        )

    def _held_means(self, step: int) -> Tensor:
        """Mean input (T/step, M) over each block of step samples, weighted by how long each is held."""
        steps = torch.diff(self.time)
        held = torch.cat((steps, steps[-1:]))[:, None]
        block = torch.arange(len(self.time), device=self.time.device) // step
        first = self.inputs[::step]
        volume = torch.zeros_like(first).index_add_(0, block, (self.inputs - first[block]) * held)
        return first + volume / torch.zeros_like(first[:, :1]).index_add_(0, block, held)

    def known_stretches(self) -> list[Recording]:
        """The longest stretches whose inputs are all known."""
        known = torch.isfinite(self.inputs).all(dim=1).to(torch.int8)
        edges = torch.diff(known, prepend=known.new_zeros(1), append=known.new_zeros(1)).nonzero().flatten().tolist()
        return [self.stretch(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
