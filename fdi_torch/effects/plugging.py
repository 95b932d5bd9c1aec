"""A clogged pipe or outlet."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Local, Stage, Values
from fdi_torch.plant.reach import Reach, onsets


class Plugging(Effect):
    """The flow falls to (1 - b) of its law from an onset on, at once or over a ramp; negative b: wider than believed
    (2020 paper, eq. 28).

    Typical: b of 0.05 to 0.6. Within the tolerance of the discharge coefficient it cannot be told from it.
    """

    name = "plugging"
    stage = Stage.FLOW
    places = ("pipe", "outlet")
    mistaken_for = ("openness", "net_outlet", "coefficient_drift", "leak", "cross_flow", "laminar_flow")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "1", 0.0, -1.0, 1.0, meaning="share of the flow that is lost (b)", extremes=(1.0,)),
            Parameter("onset", "s", 0.0, 0.0, meaning="when it begins"),
            Parameter("ramp", "s", 0.0, 0.0, meaning="how long it takes to come in full"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        begun = [{}, *({"onset": instant} for instant in onsets(reach))]
        return [{"size": size} | onset for onset in begun for size in (0.1, -0.1)]

    def flow(self, flow: Tensor, local: Local, p: Values) -> Tensor:
        return flow * (1.0 - p["size"] * local.clock.risen(p["onset"], p["ramp"]))
