"""A pump whose hose is empty at first."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale

# Hose volume as seconds at full command, for a time scale of 1 s: the upper bound, and the starting points of a fit.
FULL_FOR = 20.0
STARTS = (0.5, 2.0, 6.0)
MOST_PASSED = 0.9
RAN_FOR = 10.0  # s, on a plant whose time scale is 1 s


class PumpPriming(Effect):
    """The first volume V that the pump delivers fills its hose. Meanwhile a share r of the flow already reaches the
    tank (a pump that draws air and water): with the pumped volume P(t) = integral of u dt since the recording's start,
    the volume max(P - V, r P) has reached the tank. The mean over each step is exact, so that the filling may end
    within a step.

    A pump that runs at the first sample is taken to have run for a time T before it, so that its hose is full unless
    the command is very small. A pump that stops later keeps its hose full. Typical: V of 5 to 300 cm^3 for a metre of
    hose and a pump head; r of 0, or 0.5 with air in the pump. No effect after the first stroke, during which it is like
    a delay.
    """

    name = "pump_priming"
    stage = Stage.COMMAND
    places = ("pump",)
    memory = 1
    startup_only = True
    searched = False
    mistaken_for = ("pump_delay", "unmetered_flow", "pump_dead_zone")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        pump = plant.metered_flow(place)
        unit = {"m^3/s": "m^3", "1": "s"}.get(pump.command_unit, f"{pump.command_unit}*s")
        high = FULL_FOR * time_scale(plant) * pump.max_flow / pump.gain
        return (
            Parameter("volume", unit, 0.0, 0.0, high, meaning="volume of the hose"),
            Parameter(
                "passed",
                "1",
                0.0,
                0.0,
                MOST_PASSED,
                meaning="share of the flow that reaches the tank while the hose fills",
            ),
            Parameter(
                "ran_for",
                "s",
                RAN_FOR * time_scale(plant),
                0.0,
                meaning="assumed run time before the recording of a pump that runs at its start",
            ),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        pump = plant.metered_flow(place)
        return [{"volume": seconds * time_scale(plant) * pump.max_flow / pump.gain} for seconds in STARTS]

    def steady_memory(self, value: torch.Tensor, p: Values) -> Memory:
        pumped = value * p["ran_for"]
        # At command 0 and volume 0 both arguments of the minimum are 0 and would share the slope.
        return (torch.where(value > 0.0, torch.minimum(p["volume"] + 0.0 * pumped, pumped), torch.zeros_like(pumped)),)

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        missing = torch.clamp(p["volume"] - memory[0], min=0.0)
        filling = (1.0 - p["passed"]) * value * clock.step
        taken = torch.where(value > 0.0, torch.minimum(missing, filling), torch.zeros_like(missing * filling))
        return value - taken / clock.step, (memory[0] + taken,)
