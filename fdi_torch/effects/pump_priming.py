"""A pump whose hose is empty at first."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription, Pump
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.pace import time_scale
from fdi_torch.plant.reach import Reach
from fdi_torch.plant.signals import Clock

# Seconds at full command, on a plant whose time scale is 1 s: the largest hose, and where a fit begins.
FULL_FOR = 20.0
STARTS = (0.5, 2.0, 6.0)
MOST_PASSED = 0.9
RAN_FOR = 10.0  # s, on a plant whose time scale is 1 s


class PumpPriming(Effect):
    """Of what a pump delivers the first V fills its hose. Until that is full a share r of the flow passes beside what
    fills it (a pump that draws air and water): with the pumped volume P(t) = integral of u dt since the recording's
    start, max(P - V, r P) has reached the tank. The mean over each step is exact, so that the filling need not end
    with a step. A pump that runs at the first sample has done so for T already, as far as the hose goes: it is full
    unless the command is next to nothing. A pump that stands later keeps it full.

    Typical: V of 5 to 300 cm^3 for a metre of hose and a pump head, r of 0, and of 0.5 where air is in the pump. After
    the first stroke nothing shows; over that stroke it is a delay.
    """

    name = "pump_priming"
    stage = Stage.COMMAND
    places = ("pump",)
    memory = 1
    at_first = True
    mistaken_for = ("pump_delay", "unmetered_flow", "pump_dead_zone")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        pump = _pump(plant, place)
        unit = {"m^3/s": "m^3", "1": "s"}.get(pump.command_unit, f"{pump.command_unit}*s")
        high = FULL_FOR * time_scale(plant) * pump.max_flow / pump.gain
        return (
            Parameter("volume", unit, 0.0, 0.0, high, meaning="what fills the hose and never reaches the tank"),
            Parameter("passed", "1", 0.0, 0.0, MOST_PASSED, meaning="share that reaches the tank while the hose fills"),
            Parameter(
                "ran_for", "s", RAN_FOR * time_scale(plant), 0.0, meaning="how long one that runs at the start has run"
            ),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        pump = _pump(plant, place)
        return [{"volume": seconds * time_scale(plant) * pump.max_flow / pump.gain} for seconds in STARTS]

    def remember(self, value: Tensor, p: Values) -> Memory:
        pumped = value * p["ran_for"]
        # Not the minimum alone: at rest and at a volume of 0 both are 0, and each would get half of the slope.
        return (torch.where(value > 0.0, torch.minimum(p["volume"] + 0.0 * pumped, pumped), torch.zeros_like(pumped)),)

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        missing = torch.clamp(p["volume"] - memory[0], min=0.0)
        filling = (1.0 - p["passed"]) * value * clock.step
        taken = torch.where(value > 0.0, torch.minimum(missing, filling), torch.zeros_like(missing * filling))
        return value - taken / clock.step, (memory[0] + taken,)


def _pump(plant: PlantDescription, place: str) -> Pump:
    pump = plant.component(place)
    assert isinstance(pump, Pump)
    return pump
