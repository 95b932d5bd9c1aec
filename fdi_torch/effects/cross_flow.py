"""An unknown path between two tanks."""

from __future__ import annotations

import torch

from fdi_torch.effects.laminar_flow import torricelli_share
from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import interior_points

VISCOUS = 0.75  # softness of a transition where viscous and inertial losses add up
NARROWEST = 0.1  # largest transition head, as a share of the height


class CrossFlow(Effect):
    """s C sqrt(2 g) sqrt(max(h_1 - z, 0) - max(h_2 - z, 0)) from the first tank to the second, signed: a valve left
    open, a gap in a wall, a hose. A narrow gap is linear in the head at low heads (`laminar_flow`).

    size: capacity relative to the first tank's leak reference. Typical: 0.02 to 0.5, transition head of 0 to a few mm.
    The same as a wider pipe if a pipe joins the two tanks.
    """

    name = "cross_flow"
    stage = Stage.BALANCE
    places = ("tank_pair",)
    capacity_share = True
    mistaken_for = ("plugging", "laminar_flow", "leak", "valve_leak", "openness")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "1", 0.0, 0.0, 1.0, meaning="capacity relative to the first tank's reference pipe"),
            Parameter(
                "height", "m", 0.0, 0.0, _lowest_rim(place, plant), meaning="height of the path above the floors"
            ),
            Parameter(
                "transition_head",
                "m",
                0.0,
                0.0,
                NARROWEST * _lowest_rim(place, plant),
                meaning="head below which the flow is linear",
            ),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        first, second = (operating_range.levels[tank] for tank in plant.tanks_at(place))
        highest = min(max(first[1], second[1]), _lowest_rim(place, plant))
        heights = interior_points((0.0, highest), 2)
        narrow = {"size": 0.1, "transition_head": 0.05 * NARROWEST * _lowest_rim(place, plant)}
        return [narrow, *({"size": 0.1, "height": height} for height in heights)]

    def inflow(self, local: Local, p: Values) -> torch.Tensor:
        near = torch.clamp(local.level - p["height"], min=0.0)
        far = torch.clamp(local.far_level - p["height"], min=0.0)
        head = near - far
        share = torricelli_share(p["transition_head"] / local.magnitude(head), VISCOUS)
        return p["size"] * local.capacity * share * local.root(head)


def _lowest_rim(place: str, plant: PlantDescription) -> float:
    """Upper limit of the path's height, m: just below the lower of both rims."""
    return 0.95 * min(t.height for t in map(plant.tank, plant.tanks_at(place)))
