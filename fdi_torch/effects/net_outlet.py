"""Plugging of an outlet and a leak of its tank in one parameter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch

from fdi_torch.plant.effect import Effect, Equivalents, Local, Parameter, PlantDescription, Stage, Values


class NetOutlet(Effect):
    """The outflow is theta times the outlet's law; nominal 1 (theta_2 of the 2020 paper, eq. 31, as an outflow).

    Plugging b of an outlet and a floor leak k of its tank (relative to a pipe of rho times the outlet's capacity) act
    through the same sqrt(2 g h). Only theta = 1 - b + rho k is identifiable: below 1 plugging prevails, above 1 the
    leak.
    """

    name = "net_outlet"
    stage = Stage.FLOW
    places: ClassVar[tuple[str, ...]] = ("outlet",)
    searched = False
    mistaken_for: ClassVar[tuple[str, ...]] = ("plugging", "leak")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("size", "1", 1.0, -1.0, 2.0, meaning="net outflow relative to the outlet's law"),)

    def equivalents(self, place: str, plant: PlantDescription, values: Mapping[str, float]) -> Equivalents:
        return {("plugging", place): {"size": 1.0 - values.get("size", 1.0)}}

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * p["size"]
