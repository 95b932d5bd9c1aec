"""Weirs: overflow over a crest below the rim, into another tank or to the outside."""

from __future__ import annotations

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
from fdi_torch.plant.orifice import limit_spill, weir_law, weir_slope, weir_strength

SMALLEST_HEAD = 1e-9  # m; the law is smooth at the crest, so that only divisors need a width


@dataclass(frozen=True)
class Weir(FlowComponent):
    """A rectangular notch in the wall of `source`, over which water falls into `target` or to the outside.

    The flow is Q = (2/3) C_d b sqrt(2 g) x^(3/2) at the level's height x above the crest (Poleni, 1717; Bos, 1989,
    "Discharge Measurement Structures", ch. 5; C_d is about 0.6 for a sharp crest). crest: height above the source's
    floor, m; width b of the notch, m. The nappe falls freely: the target's level must stay below the crest.
    """

    name: str
    source: str = word_field("the tank it starts from")
    target: str = word_field("the tank it leads to, or outside", written_default=OUTSIDE)
    crest: float = quantity_field("m", "height of the crest above the floor of its source, m", role="estimated")
    width: float = quantity_field("m", "length of the crest across the flow, m", role="estimated")
    discharge_coefficient: float = quantity_field(
        "1", "of the weir, without unit", role="estimated", most=LARGEST_DISCHARGE_COEFFICIENT, default=0.6
    )

    order = FlowOrder.SPILL
    place_kinds = ("weir",)
    accepts = ("plugging", "coefficient_drift", "flow_exponent", "outlet_drop")
    usual_faults = ("plugging.size",)

    @classmethod
    def example(cls, name: str, source: str, target: str) -> Self:
        return cls(name, source, target, 0.2, 0.02)

    @property
    def depends_on(self) -> tuple[str, ...]:
        return (self.source,)

    @property
    def datum(self) -> float:
        return self.crest

    @property
    def falls(self) -> bool:
        return True

    def problems(self) -> Iterator[str]:
        return coefficient_problems(self.discharge_coefficient)

    def capacity(self, constants: Values, gravity: torch.Tensor) -> torch.Tensor:
        return weir_strength(constants["discharge_coefficient"], constants["width"], gravity)

    def smoothing_width(self, gravity: float, inverse_areas: float, resolution: torch.Tensor) -> torch.Tensor:
        return torch.full_like(resolution, SMALLEST_HEAD)

    def head(self, local: Local) -> torch.Tensor:
        return local.level - local.constants["crest"]

    def law(self, local: Local) -> torch.Tensor:
        return weir_law(local.head, local.capacity)[0]

    def limited(self, flow: torch.Tensor, local: Local) -> torch.Tensor:
        if not local.clock.explicit:
            return flow
        slope = weir_slope(flow, local.head)
        return limit_spill(
            flow, slope, excess=local.head, inflow=local.net, tank_area=local.area, resolution=local.clock.resolution
        )

    def sketch(self) -> Sketch:
        return Sketch("over_wall", self.crest)
