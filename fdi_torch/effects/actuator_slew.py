"""A pump, transfer or valve with a limited slew rate."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.metered_flow import MeteredFlow
from fdi_torch.plant.scales import time_scale

SLOWNESS_UNITS = {"m^3/s": "s^2/m^3", "V": "s/V", "A": "s/A", "1/s": "s^2", "1": "s"}


class ActuatorSlew(Effect):
    """|dv/dt| <= 1/s, with the slowness s: motor-driven valves, ramps in a drive. The mean over each step is exact for
    a command held over the step.

    slowness: time to move by one unit of the command (a valve: by its whole stroke). Typical: a whole stroke in 2 to 60
    s. Nearly the same as a lag if all steps of the command are equally large.
    """

    name = "actuator_slew"
    stage = Stage.COMMAND
    places = ("pump", "valve")
    memory = 1
    searched = False
    mistaken_for = ("pump_lag", "pump_delay", "valve_lag", "actuator_stuck")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        actuator = plant.flow(place)
        unit = actuator.command_unit if isinstance(actuator, MeteredFlow) else "1"  # a valve's opening is 0 to 1
        slowest = 120.0 * time_scale(plant) / actuator.full_command
        return (Parameter("slowness", SLOWNESS_UNITS[unit], 0.0, 0.0, slowest, meaning="time to move by one unit"),)

    def steady_memory(self, value: torch.Tensor, p: Values) -> Memory:
        return (value,)

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        gap = memory[0] - value
        needed = torch.abs(gap) * p["slowness"] / clock.step
        moving = torch.clamp(needed, max=1.0)  # share of the step in which it moves
        remaining = gap * (1.0 - 1.0 / torch.clamp(needed, min=1.0))
        return value + remaining + 0.5 * moving * (gap - remaining), (value + remaining,)
