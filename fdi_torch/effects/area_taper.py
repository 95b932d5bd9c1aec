"""A tank that widens or narrows towards its rim."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values


class AreaTaper(Effect):
    """The cross-section is A (1 + s (h/H - 1/2)): s is its change from floor to rim as a share of the mean, so that
    it stays apart from A.

    Typical: s of -0.5 to 0.5. It changes how fast levels move, never where they come to rest, like an internal body.
    """

    name = "area_taper"
    stage = Stage.STORAGE
    places = ("tank",)
    mistaken_for = ("internal_body", "sensor_curvature")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("taper", "1", 0.0, -1.6, 1.6, meaning="change of area from floor to rim, over the mean"),)

    def area(self, area: Tensor, local: Local, p: Values) -> Tensor:
        return area * torch.clamp(1.0 + p["taper"] * (local.level / local.height - 0.5), min=0.05)
