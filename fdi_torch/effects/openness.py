"""The open share of a pipe, one minus its plugging: the parameter of the 2020 paper."""

from __future__ import annotations

from fdi_torch.effects.net_outlet import NetOutlet
from fdi_torch.plant.effect import Parameter, PlantDescription


class Openness(NetOutlet):
    """The flow is theta times the pipe's law; nominal 1: theta_4 = 1 - b_1, theta_5 = 1 - b_3 (2020 paper, eq. 31).

    The same as plugging of 1 - theta; use only one of the two at a place.
    """

    name = "openness"
    places = ("pipe",)
    mistaken_for = ("plugging", "cross_flow")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("size", "1", 1.0, 0.0, 1.0, meaning="share of the nominal flow that passes"),)
