"""Recording: time, inputs, outputs and where they came from; the one thing rooms hand each other. All is SI."""

from __future__ import annotations

from dataclasses import dataclass, field
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

    def stretch(self, first: int, last: int) -> Recording:
        """Samples first..last-1, with the same clock."""
        return Recording(
            self.time[first:last],
            self.inputs[first:last],
            self.outputs[first:last],
            self.input_names,
            self.output_names,
            self.input_units,
            self.output_units,
            self.mask[first:last],
            self.hold,
            self.source,
            self.sha256,
        )

    def known_stretches(self) -> list[Recording]:
        """The longest stretches whose inputs are all known."""
        known = torch.isfinite(self.inputs).all(dim=1).to(torch.int8)
        edges = torch.diff(known, prepend=known.new_zeros(1), append=known.new_zeros(1)).nonzero().flatten().tolist()
        return [self.stretch(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
