"""A hole in a tank's wall."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from fdi_torch.plant.constants import leak_pipe, share_of_hole
from fdi_torch.plant.effect import (
    Effect,
    Equivalents,
    Local,
    OperatingRange,
    Parameter,
    PlantDescription,
    Stage,
    Values,
)
from fdi_torch.plant.operating_range import interior_points, timed_starts


class Leak(Effect):
    """Outflow s(t) C sqrt(2 g) sqrt(h - z) through a hole at height z; s(t) rises from 0 to s at an onset, at once or
    over a ramp (2020 paper, eq. 27, 30).

    size: capacity of the hole relative to the tank's leak reference (theta_1, theta_3 of eq. 31). Typical: 0.05 to 0.5.
    The same as a wider outlet if it is at the floor of a tank with an outlet.
    """

    name = "leak"
    stage = Stage.BALANCE
    places = ("tank",)
    instants = ("onset",)
    capacity_share = True
    mistaken_for = ("plugging", "net_outlet", "valve_leak", "unmetered_flow", "cross_flow", "overflow", "evaporation")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        tank, reference = plant.tank(place), leak_pipe(plant, place).name
        return (
            Parameter("size", "1", 0.0, 0.0, 1.0, meaning=f"capacity of the hole relative to that of {reference}"),
            Parameter("height", "m", 0.0, 0.0, 0.95 * tank.height, meaning="height of the hole above the floor"),
            Parameter("onset", "s", 0.0, 0.0, meaning="time at which it opens"),
            Parameter("ramp", "s", 0.0, 0.0, meaning="time until fully open"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        low, high = operating_range.levels[place]
        at_height = [{"size": 0.1, "height": height} for height in (0.5 * low, *interior_points((low, high), 3))]
        permanent, *timed = timed_starts([{"size": 0.1}], operating_range)
        return [permanent, *at_height, *timed]

    def equivalents(self, place: str, plant: PlantDescription, values: Mapping[str, float]) -> Equivalents:
        if values.get("height", 0.0) > 0.0:
            return {}
        size, timing = values.get("size", 0.0), {n: v for n, v in values.items() if n != "height"}
        return {
            ("plugging", outlet): {**timing, "size": -size / share_of_hole(plant, place, outlet)}
            for outlet in plant.floor_outlets(place)
        }

    def inflow(self, local: Local, p: Values) -> torch.Tensor:
        head = torch.clamp(local.level - p["height"], min=0.0)
        return -p["size"] * local.clock.risen(p["onset"], p["ramp"]) * local.capacity * local.root(head)
