"""Pumps that deliver into a tank from outside the plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from fdi_torch.plant.components import OUTSIDE, quantity_field, word_field
from fdi_torch.plant.flow_component import FlowOrder, Sketch
from fdi_torch.plant.metered_flow import MeteredFlow, gain_field

BLADE = ((-0.07, -0.1), (-0.07, 0.1), (0.13, 0.0))


@dataclass(frozen=True)
class Pump(MeteredFlow):
    """A pump that delivers gain x command into `target`, limited to 0..max_flow (m^3/s).

    command: the input channel, if its name differs from the pump's. gain: m^3/s per SI unit of the command (1 if the
    command is a flow); a gain given as text ('2 l/min/V') sets gain_unit, one of `COMMAND_UNITS`.
    """

    name: str
    target: str = word_field("the tank it fills")
    max_flow: float = quantity_field("m^3/s", "maximum flow, m^3/s", role="estimated")
    gain: float = gain_field()
    command: str | None = word_field("its input channel, if it differs from its name", default=None)
    gain_unit: str = "1"

    source = OUTSIDE
    order = FlowOrder.INFLOW
    place_kinds = ("pump",)
    usual_faults = ("pump_gain.factor", "pump_offset.offset")

    @classmethod
    def example(cls, name: str, source: str, target: str) -> Self:
        return cls(name, source if source != OUTSIDE else target, 3e-5)

    def sketch(self) -> Sketch:
        return Sketch("from_above", symbol=BLADE, round=0.17)
