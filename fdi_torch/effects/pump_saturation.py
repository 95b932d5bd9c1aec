"""A pump or transfer whose maximum flow is below its nominal limit."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import interior_points

DRY = 1e-12  # m^3/s, or relative: counts as no flow
SHARPEST = 1e-3  # rounding below which the limit is a kink


class PumpSaturation(Effect):
    """The flow is min(q, q_max), or smoothly limited: q / (1 + (q/q_max)^(1/r))^r with r = k (1 - q_max/q_full). The
    nominal limit is the plant file's q_full, where the effect is absent.

    Typical: 60 to 90 % of the nominal limit, a knee k of 0 to 0.3. No effect while the flow stays below the limit.
    """

    name = "pump_saturation"
    stage = Stage.FLOW
    places = ("pump",)
    smooth = False
    mistaken_for = ("pump_gain", "actuator_stuck", "pump_curve", "pump_back_pressure", "pump_cut_out")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        pump = plant.metered_flow(place)
        full = pump.max_flow
        return (
            Parameter("limit", "m^3/s", full, 0.0, full, meaning="maximum flow of the pump"),
            Parameter("knee", "1", 0.0, 0.0, 1.0, meaning="smoothness of the limit"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        pump = plant.metered_flow(place)
        commanded = tuple(min(max(pump.gain * u, 0.0), pump.max_flow) for u in operating_range.commands[pump.channel])
        return [{"limit": limit, "knee": 0.1} for limit in interior_points((commanded[0], commanded[1]), 7)]

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        least = torch.minimum(flow, p["limit"])
        share = least / torch.clamp(torch.maximum(flow, p["limit"]), min=DRY)
        round_off = p["knee"] * (1.0 - p["limit"] / local.constants["max_flow"])
        near = torch.exp(torch.log(torch.clamp(share, min=DRY)) / torch.clamp(round_off, min=SHARPEST))
        return least * torch.exp(-round_off * torch.log(1.0 + near))
