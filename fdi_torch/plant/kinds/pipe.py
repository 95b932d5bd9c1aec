"""Pipes and outlets: orifices between two tanks or to the outside, with or without a valve."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import torch

from fdi_torch.plant.components import OUTSIDE, quantity_field, word_field
from fdi_torch.plant.flow_component import (
    LARGEST_DISCHARGE_COEFFICIENT,
    FlowComponent,
    FlowOrder,
    Sketch,
    coefficient_problems,
)
from fdi_torch.plant.local_conditions import Local, Values
from fdi_torch.plant.orifice import regular_width
from fdi_torch.quantities import quantity_text
from fdi_torch.recording import LARGEST

BOW_TIE = ((-0.12, 0.08), (-0.12, -0.08), (0.12, 0.08), (0.12, -0.08))


@dataclass(frozen=True)
class Pipe(FlowComponent):
    """An orifice from one tank into another tank or to the outside: area m^2; elevation m above both floors.

    The flow is C_d a o sgn(x) sqrt(2 g |x|) with the head x and the valve's opening o (Torricelli). free_fall: whether
    it pours into `target` from above, so that only the source's level drives it (always true of an outlet to the
    outside). valve: the input channel with the measured opening (0..1) of its valve. unrecorded: the opening in
    recordings without that channel; None requires the channel in every recording.
    """

    name: str
    source: str = word_field("the tank it starts from")
    target: str = word_field("the tank it leads to, or outside", written_default=OUTSIDE)
    area: float = quantity_field("m^2", "of the orifice, m^2", role="estimated")
    discharge_coefficient: float = quantity_field(
        "1", "of the orifice, without unit", role="estimated", most=LARGEST_DISCHARGE_COEFFICIENT
    )
    elevation: float = quantity_field("m", "of the orifice above both floors, m", role="constant", default=0.0)
    free_fall: bool = word_field("whether it pours into its target from above", default=False)
    valve: str | None = word_field("the input channel with its measured opening, 0 to 1", default=None)
    unrecorded: float | None = quantity_field(
        "1", "its opening in recordings that lack the channel", least=0.0, most=1.0, default=None
    )

    order = FlowOrder.BY_LEVELS
    place_kinds = ("pipe", "outlet")
    usual_faults = ("plugging.size",)

    @classmethod
    def example(cls, name: str, source: str, target: str) -> Self:
        return cls(name, source, target, 0.5e-4, 0.6)

    @property
    def is_outlet(self) -> bool:
        return self.target == OUTSIDE or self.free_fall

    @property
    def place_kind(self) -> str:
        return "outlet" if self.is_outlet else "pipe"

    @property
    def depends_on(self) -> tuple[str, ...]:
        return (self.source,) if self.is_outlet else (self.source, self.target)

    @property
    def datum(self) -> float:
        return self.elevation if self.is_outlet else 0.0

    @property
    def falls(self) -> bool:
        return self.free_fall

    @property
    def input_channel(self) -> tuple[str, str] | None:
        return (self.valve, "1") if self.valve else None

    def problems(self) -> Iterator[str]:
        yield from coefficient_problems(self.discharge_coefficient)
        if self.unrecorded is not None and not 0 <= self.unrecorded <= 1:
            yield f"unrecorded: expected an opening from 0 to 1, got {self.unrecorded:g}"
        if not 0 <= self.elevation <= LARGEST:
            yield (
                f"elevation: expected at least 0 m above both floors, got {quantity_text(self.elevation, 'm')}; move "
                "the zero of the tanks' levels below the pipe"
            )

    def actuated(self, value: torch.Tensor) -> torch.Tensor:
        return torch.clamp(value, 0.0, 1.0)

    def nominal_capacity(self, gravity: float) -> float:
        """Nominal C_d a sqrt(2 g): flow at 1 m of head, m^2.5/s."""
        return self.discharge_coefficient * self.area * math.sqrt(2.0 * gravity)

    def capacity(self, constants: Values, gravity: torch.Tensor) -> torch.Tensor:
        return constants["discharge_coefficient"] * constants["area"] * torch.sqrt(2.0 * gravity)

    def smoothing_width(self, gravity: float, inverse_areas: float, resolution: torch.Tensor) -> torch.Tensor:
        return regular_width(self.nominal_capacity(gravity) * inverse_areas, resolution)

    def head(self, local: Local) -> torch.Tensor:
        elevation = local.constants["elevation"]
        if self.is_outlet:
            return local.level - elevation
        if not self.elevation:
            return local.level - local.far_level
        return torch.clamp(local.level - elevation, min=0.0) - torch.clamp(local.far_level - elevation, min=0.0)

    def law(self, local: Local) -> torch.Tensor:
        head = torch.clamp(local.head, min=0.0) if self.is_outlet else local.head
        return local.capacity * local.command * local.root(head)

    def sketch(self) -> Sketch:
        return Sketch("pipe", self.elevation, self.is_outlet, BOW_TIE if self.valve else ())
