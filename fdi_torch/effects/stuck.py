"""Base of the stuck actuator and the stuck sensor, which hold their value from an onset on."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Memory, OperatingRange, Parameter, PlantDescription, Values
from fdi_torch.plant.operating_range import interior_points


class Stuck(Effect):
    """value <- value + size s (held - value), with the share s of the step after the onset (Isermann, 2006, ch. 5).

    size: 1 for fully stuck, 0 for free; in between, the share of the signal's change that is lost.
    """

    memory = 1
    instants = ("onset",)

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "1", 0.0, 0.0, 1.0, meaning="share of the signal's change that is lost", extremes=(1.0,)),
            Parameter("onset", "s", 0.0, 0.0, meaning="time at which it sticks"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        return [{"size": 0.9, "onset": onset} for onset in (0.0, *interior_points((0.0, operating_range.duration), 5))]

    def steady_memory(self, value: torch.Tensor, p: Values) -> Memory:
        return (value,)

    def hold(self, value: torch.Tensor, memory: Memory, share: torch.Tensor, p: Values) -> tuple[torch.Tensor, Memory]:
        """The partly held value and the new memory; share: of the step, after the onset."""
        held = value + share * (memory[0] - value)
        return value + p["size"] * share * (held - value), (held,)
