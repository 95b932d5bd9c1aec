"""An outlet or a crest that lies lower or higher than in the plant file."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import source_height
from fdi_torch.plant.effect import Effect, Local, Parameter, PlantDescription, Stage, Values


class OutletDrop(Effect):
    """The head is x + d: the law with the orifice or crest d below its height in the plant file, as at the end of a
    drain hose; negative: above it, without flow at lower levels.

    Typical: d of -3 to 10 cm. Nearly the same as another exponent of the head or laminar flow.
    """

    name = "outlet_drop"
    stage = Stage.FLOW
    places = ("outlet",)
    mistaken_for = ("laminar_flow", "flow_exponent", "evaporation", "pump_offset", "sensor_bias")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        far = 0.3 * source_height(plant, place)
        return (Parameter("drop", "m", 0.0, -far, far, meaning="distance below its height in the plant file"),)

    def head(self, head: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return head + p["drop"]
