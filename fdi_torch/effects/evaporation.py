"""Evaporation from a tank."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import length_scale, time_scale


class Evaporation(Effect):
    """The tank loses the flow r A at every level, with its nominal cross-section A.

    Typical: r of 0.05 to 0.5 mm/h (1e-8 to 1e-7 m/s), more from hot or ventilated surfaces. The same as a constant draw
    without end, or as a dead zone of the tank's pump.
    """

    name = "evaporation"
    stage = Stage.BALANCE
    places = ("tank",)
    searched = False
    mistaken_for = (
        "pump_offset",
        "pump_dead_zone",
        "unmetered_flow",
        "leak",
        "flow_exponent",
        "outlet_drop",
        "laminar_flow",
    )

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        fastest = 2e-5 * length_scale(plant) / time_scale(plant)
        return (Parameter("rate", "m/s", 0.0, 0.0, fastest, meaning="fall of the level in a still tank"),)

    def inflow(self, local: Local, p: Values) -> torch.Tensor:
        return -p["rate"] * local.constants["area"]
