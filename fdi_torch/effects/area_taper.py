"""A tank whose cross-section widens or narrows towards its rim."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values


class AreaTaper(Effect):
    """The cross-section is A (1 + s (h/H - r)): s is its change from floor to rim relative to A, and A is the area at
    the level r H (half height by default; r = 0 if it was measured at the floor).

    Typical: s of -0.5 to 0.5, r of 0 or 1/2. Like an internal body, it changes how fast levels move but no steady
    state.
    """

    name = "area_taper"
    stage = Stage.STORAGE
    places = ("tank",)
    mistaken_for = ("internal_body", "sensor_curvature")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("taper", "1", 0.0, -1.6, 1.6, meaning="change of area from floor to rim, relative"),
            Parameter(
                "reference", "1", 0.5, 0.0, 1.0, meaning="level at which the area is nominal, relative to the height"
            ),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        return [{"taper": s, "reference": r} for r in (0.5, 0.0) for s in (0.16, -0.16)]

    def area(self, area: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return area * torch.clamp(1.0 + p["taper"] * (local.level / local.height - p["reference"]), min=0.05)
