"""A temporary unmeasured inflow or draw."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import flow_scale
from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale


class UnmeteredFlow(Effect):
    """A constant inflow q (negative: a draw) that begins at one instant and lasts for a duration; exact for any step.

    Typical: 5 to 50 % of a pump's flow over minutes. The same as an offset or dead zone of the tank's pump if it never
    ends.
    """

    name = "unmetered_flow"
    stage = Stage.BALANCE
    places = ("tank",)
    instants = ("begin", "duration")
    mistaken_for = ("leak", "evaporation", "pump_offset", "pump_dead_zone", "coefficient_drift")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        flow = flow_scale(plant, place)
        return (
            Parameter("flow", "m^3/s", 0.0, -flow, flow, meaning="inflow (negative: draw)"),
            Parameter("begin", "s", 0.0, 0.0, meaning="time at which it begins"),
            Parameter("duration", "s", 600.0 * time_scale(plant), 0.0, meaning="duration"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        flow = 0.1 * flow_scale(plant, place)
        # Those that would end exactly at the last sample, which is a kink of the cost, go on beyond it.
        shares = [(k / 4, 1 / 4) for k in range(3)] + [(k / 8, 1 / 2) for k in range(4)] + [(1 / 2, 1.0), (3 / 4, 1.0)]
        return [
            {
                "flow": sign * flow,
                "begin": begin * operating_range.duration,
                "duration": lasting * operating_range.duration,
            }
            for begin, lasting in shares
            for sign in (-1.0, 1.0)
        ]

    def inflow(self, local: Local, p: Values) -> torch.Tensor:
        begun = local.clock.share_after(p["begin"])
        ended = local.clock.share_after(p["begin"] + p["duration"])
        return p["flow"] * (begun - ended)
