"""A clogged pipe or outlet."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from fdi_torch.plant.constants import share_of_hole
from fdi_torch.plant.effect import (
    Effect,
    Equivalents,
    Local,
    OperatingRange,
    Parameter,
    PlantDescription,
    Stage,
    Values,
    place_kind,
)
from fdi_torch.plant.operating_range import onset_grid


class Plugging(Effect):
    """The flow falls to (1 - b) of its law at an onset, at once or over a ramp; b < 0: wider than nominal (2020 paper,
    eq. 28).

    Typical: b of 0.05 to 0.6. Indistinguishable from the discharge coefficient's error within its tolerance.
    """

    name = "plugging"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    instants = ("onset",)
    mistaken_for = ("openness", "net_outlet", "coefficient_drift", "leak", "cross_flow", "laminar_flow")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "1", 0.0, -1.0, 1.0, meaning="lost share of the flow", extremes=(1.0,)),
            Parameter("onset", "s", 0.0, 0.0, meaning="time at which it begins"),
            Parameter("ramp", "s", 0.0, 0.0, meaning="time until full size"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        # One that grows is a drifting coefficient.
        times = [{}, *({"onset": instant} for instant in onset_grid(operating_range))]
        return [{"size": size} | onset for onset in times for size in (0.1, -0.1)]

    def equivalents(self, place: str, plant: PlantDescription, values: Mapping[str, float]) -> Equivalents:
        size, same = values.get("size", 0.0), dict[tuple[str, str], Mapping[str, float]]()
        constant = not (values.get("onset") or values.get("ramp"))
        share = {"outlet": "net_outlet", "pipe": "openness" if size >= 0.0 else None}.get(place_kind(plant, place))
        if share and constant:
            same[share, place] = {"size": 1.0 - size}
        source = next((p.source for p in plant.pipes if p.name == place), "")
        if size <= 0.0 and place in plant.floor_outlets(source):
            same["leak", source] = {**values, "size": -size * share_of_hole(plant, source, place)}
        return same

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * (1.0 - p["size"] * local.clock.risen(p["onset"], p["ramp"]))
