"""What a stuck actuator and a stuck sensor have in common: from an onset on they stay where they then are."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Memory, Values
from fdi_torch.plant.reach import Reach, inside


class Stuck(Effect):
    """value <- value + size s (held - value), s the share of the step after the onset (Isermann, 2006, ch. 5).

    size: 1 where it is stuck, 0 where it follows; between them the share of its stroke that is lost.
    """

    memory = 1

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "1", 0.0, 0.0, 1.0, meaning="share of its stroke that it has lost", extremes=(1.0,)),
            Parameter("onset", "s", 0.0, 0.0, meaning="when it gets stuck"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        return [{"size": 0.9, "onset": onset} for onset in (0.0, *inside((0.0, reach.duration), 5))]

    def remember(self, value: Tensor, p: Values) -> Memory:
        return (value,)

    def held(self, value: Tensor, memory: Memory, share: Tensor, p: Values) -> tuple[Tensor, Memory]:
        """share: of the step, after the onset."""
        held = value + share * (memory[0] - value)
        return value + p["size"] * share * (held - value), (held,)
