"""Metered transfers: commanded or measured flows out of a tank, into another one or to the outside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch

from fdi_torch.plant.components import OUTSIDE, quantity_field, word_field
from fdi_torch.plant.flow_component import FlowOrder, Sketch
from fdi_torch.plant.local_conditions import Local
from fdi_torch.plant.metered_flow import MeteredFlow, gain_field
from fdi_torch.plant.orifice import limit_draw

ARROW = ((-0.05, -0.08), (-0.05, 0.08), (0.1, 0.0))


@dataclass(frozen=True)
class Transfer(MeteredFlow):
    """A flow of gain x command from `source` to `target` (or outside), limited to 0..max_flow (m^3/s).

    The command is the flow itself, commanded or measured, or the signal of the transfer pump or flow meter. A dry
    source passes on only what flows into it (see `limit_draw`); of several transfers from one dry tank the first one in
    the plant is served first. command: the input channel, if its name differs from the transfer's. gain: m^3/s per SI
    unit of the command (1 if it is a flow); a gain given as text ('2 l/min/V') sets gain_unit, one of `COMMAND_UNITS`.
    """

    name: str
    source: str = word_field("the tank it draws from")
    target: str = word_field("the tank it leads to, or outside", written_default=OUTSIDE)
    max_flow: float = quantity_field("m^3/s", "maximum flow, m^3/s", role="estimated")
    gain: float = gain_field()
    command: str | None = word_field("its input channel, if it differs from its name", default=None)
    gain_unit: str = "1"

    order = FlowOrder.SUPPLY
    place_kinds = ("transfer",)
    accepts = (
        *("actuator_stuck", "actuator_slew", "pump_lag", "pump_delay", "pump_dead_zone"),
        *("pump_gain", "pump_curve", "pump_oscillation", "pump_offset", "pump_saturation"),
    )
    usual_faults = ("pump_gain.factor", "pump_offset.offset")

    @classmethod
    def example(cls, name: str, source: str, target: str) -> Self:
        return cls(name, source, target, 3e-5)

    def limited(self, flow: torch.Tensor, local: Local) -> torch.Tensor:
        return limit_draw(flow, local.level, local.net, local.area, local.clock.resolution)

    def sketch(self) -> Sketch:
        return Sketch("pipe", symbol=ARROW, round=0.13)
