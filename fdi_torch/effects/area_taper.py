"""A tank whose cross-section widens or narrows towards its rim."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values

LEAST_WIDTH = 0.05  # relative to the width where the area is nominal


class AreaTaper(Effect):
    """The cross-section is A (1 + s (h/H - r) / p)^p: A is the area at the level r H (half height by default; r = 0 if
    measured at the floor), s its slope there times H/A. p = 1: two opposite walls are inclined; p = 2: all of
    them, as in a cone.

    Typical: s of -0.5 to 0.5, r of 0 or 1/2, p of 1 or 2. Like an internal body, it changes how fast levels move but no
    steady state.
    """

    name = "area_taper"
    stage = Stage.STORAGE
    places = ("tank",)
    mistaken_for = ("internal_body", "sensor_curvature")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("taper", "1", 0.0, -1.6, 1.6, meaning="slope of the area times height over area, where nominal"),
            Parameter(
                *("reference", "1", 0.5, 0.0, 1.0),
                meaning="level at which the area is nominal, relative to the height",
                extremes=(0.0, 1.0),
            ),
            Parameter(
                *("power", "1", 1.0, 1.0, 2.0),
                meaning="1: the area is linear in the level, 2: the width is",
                extremes=(2.0,),
            ),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        return [{"taper": s, "reference": r, "power": 1.5} for r in (0.5, 0.0) for s in (0.16, -0.16)]

    def area(self, area: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        rise = p["taper"] * (local.level / local.height - p["reference"])
        width = torch.clamp(1.0 + rise / p["power"], min=LEAST_WIDTH)
        return area * torch.exp(p["power"] * torch.log(width))
