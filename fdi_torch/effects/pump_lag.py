"""A pump or transfer that follows its command with a first-order lag."""

from __future__ import annotations

from typing import ClassVar

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale


class PumpLag(Effect):
    """tau dv/dt = u - v (any textbook on linear systems). The mean over a step is exact for a command held over it: u +
    (v_0 - u) (tau/dt) (1 - exp(-dt/tau)).

    Typical: tau of 2 to 30 s. Nearly the same as a delay of tau if tau is far below the tanks' time constants.
    """

    name = "pump_lag"
    stage = Stage.COMMAND
    places = ("pump",)
    memory = 1
    mistaken_for: ClassVar[tuple[str, ...]] = ("pump_delay", "actuator_slew", "sensor_lag", "sensor_delay")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        slowest = 60.0 * time_scale(plant)
        return (Parameter("time_constant", "s", 0.0, 0.0, slowest, meaning="time to 63 % of a step"),)

    def steady_memory(self, value: torch.Tensor, p: Values) -> Memory:
        return (value,)

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        gap = memory[0] - value
        decay = clock.decay(p["time_constant"])
        mean = value + gap * (p["time_constant"] / clock.step) * (1.0 - decay)
        return mean, (value + gap * decay,)
