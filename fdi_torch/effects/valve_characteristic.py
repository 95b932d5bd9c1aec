"""A valve whose capacity is a power of its opening."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, Parameter, PlantDescription, Stage, Values

LEAST_OPENING = 1e-6


class ValveCharacteristic(Effect):
    """The opening o acts as o^(1 + c): linear for c = 0, quick-opening for c < 0, similar to equal-percentage for c > 0
    (IEC 60534-2-1, inherent flow characteristics). Closed and fully open positions are unchanged.

    Typical: c of -0.4 to 2. The same as plugging if the opening is constant; ball valves combine it with a dead zone.
    """

    name = "valve_characteristic"
    stage = Stage.COMMAND
    places = ("valve",)
    mistaken_for = ("valve_dead_zone", "valve_leak", "actuator_stuck", "valve_authority", "plugging")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (Parameter("bend", "1", 0.0, -0.8, 4.0, meaning="exponent of the opening minus 1"),)

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        opening = torch.clamp(value, 0.0, 1.0)
        return opening * torch.exp(p["bend"] * torch.log(torch.clamp(opening, min=LEAST_OPENING))), memory
