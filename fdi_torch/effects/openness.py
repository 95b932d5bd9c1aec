"""The open share of a pipe, one minus its plugging: the parameter of the 2020 paper."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from fdi_torch.plant.effect import Effect, Local, Parameter, PlantDescription, Stage, Values


class Openness(Effect):
    """The flow is theta times the pipe's law; nominal 1: theta_4 = 1 - b_1, theta_5 = 1 - b_3 (2020 paper, eq. 31).

    The same as plugging of 1 - theta; use only one of the two at a place.
    """

    name = "openness"
    stage = Stage.FLOW
    places = ("pipe",)
    searched = False
    mistaken_for = ("plugging", "cross_flow")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("size", "1", 1.0, 0.0, 1.0, meaning="share of the nominal flow that passes"),)

    def equivalents(
        self, place: str, plant: PlantDescription, values: Mapping[str, float]
    ) -> tuple[tuple[str, str], ...]:
        return (("plugging", place),)

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * p["size"]
