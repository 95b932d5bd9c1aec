"""Base of the flow components whose flow is an input channel: pumps and metered transfers."""

from __future__ import annotations

from dataclasses import field
from typing import Any

import torch

from fdi_torch.plant.components import COMMAND_UNITS
from fdi_torch.plant.flow_component import FlowComponent
from fdi_torch.plant.local_conditions import Local, Values

GAIN_MEANING = "flow for a command of 1: none, l/min/V, l/min/mA, l/min/Hz, l/min/%; l/min of a duty"


def gain_field() -> Any:
    """A dataclass field with the flow for a command of 1, whose unit is the component's `gain_unit`; 1 by default."""
    return field(default=1.0, metadata={"meaning": GAIN_MEANING, "unit_field": "gain_unit", "role": "estimated"})


class MeteredFlow(FlowComponent):
    """A flow of gain x command, limited to 0..max_flow (m^3/s); its fields are those of `Pump`."""

    commanded = True

    max_flow: float
    gain: float
    command: str | None
    gain_unit: str

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "gain_unit", self._convert("gain", [*COMMAND_UNITS]) or self.gain_unit)

    @property
    def channel(self) -> str:
        """The name of its input channel."""
        return self.command or self.name

    @property
    def command_unit(self) -> str:
        """SI unit of the command."""
        return COMMAND_UNITS[self.gain_unit]

    @property
    def input_channel(self) -> tuple[str, str]:
        return self.channel, self.command_unit

    @property
    def full_command(self) -> float:
        return self.max_flow / self.gain

    def capacity(self, constants: Values, gravity: torch.Tensor) -> torch.Tensor:
        return constants["gain"]

    def law(self, local: Local) -> torch.Tensor:
        demanded = torch.clamp(local.capacity * local.command, min=0.0)
        return torch.minimum(demanded, local.constants["max_flow"])
