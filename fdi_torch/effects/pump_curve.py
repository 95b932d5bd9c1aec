"""A pump whose delivery is a curve of its command, not a line."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values


class PumpCurve(Effect):
    """q (1 + c (1 - q / q_max)): nothing changes at rest and at the limit, most in between, c q_max / 4.

    Typical: c of -0.4 to 0.4. Between two commands it is the same as a gain and an offset.
    """

    name = "pump_curve"
    stage = Stage.FLOW
    places = ("pump",)
    mistaken_for = ("pump_offset", "pump_dead_zone", "pump_gain", "pump_saturation")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("bend", "1", 0.0, -0.95, 0.95, meaning="extra flow at small commands, as a share of it"),)

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        return flow * (1.0 + p["bend"] * (1.0 - flow / local.constants["max_flow"]))
