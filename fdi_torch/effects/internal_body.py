"""A body inside a tank that takes up volume between two levels."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values

EDGE_SHARE = 0.01
LEAST_SHARE = 0.05


class InternalBody(Effect):
    """The cross-section is A - a between the body's bottom and top (a displacer, a float, a pump housing), or A - a (1
    - s x) at the relative height x of a body that narrows (s > 0) or widens upwards. Its edges are smoothed over 1 % of
    the tank's height to keep steps accurate and gradients finite.

    Typical: a of 10 to 50 % of A over 5 to 30 cm. No effect at levels outside the body.
    """

    name = "internal_body"
    stage = Stage.STORAGE
    places = ("tank",)
    mistaken_for = ("area_taper",)

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        tank = plant.tank(place)
        return (
            Parameter("area", "m^2", 0.0, 0.0, 0.9 * tank.area, meaning="cross-section of the body"),
            Parameter("bottom", "m", 0.2 * tank.height, 0.0, tank.height, meaning="level of the body's bottom"),
            Parameter("height", "m", 0.2 * tank.height, 0.0, tank.height, meaning="height of the body"),
            Parameter("narrowing", "1", 0.0, -1.0, 1.0, meaning="relative narrowing towards the top"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        tank = plant.tank(place)
        low, high = operating_range.levels[place]
        span = high - low
        sections = [(k / 4, 1 / 4) for k in range(4)] + [(k / 4, 1 / 2) for k in range(3)]
        return [
            {"area": 0.3 * tank.area, "bottom": low + at * span, "height": tall * span, "narrowing": 0.0}
            for at, tall in sections
        ]

    def area(self, area: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        edge = EDGE_SHARE * local.height
        above_bottom = torch.clamp((local.level - p["bottom"]) / edge + 0.5, 0.0, 1.0)
        above_top = torch.clamp((local.level - p["bottom"] - p["height"]) / edge + 0.5, 0.0, 1.0)
        risen = torch.clamp((local.level - p["bottom"]) / torch.clamp(p["height"], min=edge), 0.0, 1.0)
        body = p["area"] * (1.0 - p["narrowing"] * risen)
        return torch.maximum(area - body * (above_bottom - above_top), LEAST_SHARE * area)
