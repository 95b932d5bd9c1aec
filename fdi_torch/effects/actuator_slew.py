"""A pump or valve that moves at a limited rate."""

from __future__ import annotations

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription, Pump
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.pace import time_scale
from fdi_torch.plant.signals import Clock

SLOWNESS_UNITS = {"m^3/s": "s^2/m^3", "V": "s/V", "A": "s/A", "1/s": "s^2", "1": "s"}


class ActuatorSlew(Effect):
    """|dv/dt| <= 1/s: motor valves, ramps in a drive. Exact for a command held over a step, of which the mean is
    passed on.

    slowness: seconds for a command of one unit (a valve: for its whole stroke). Typical: a whole stroke in 2 to 60 s.
    Nearly the same as a lag where all steps are alike.
    """

    name = "actuator_slew"
    stage = Stage.COMMAND
    places = ("pump", "valve")
    memory = 1
    mistaken_for = ("pump_lag", "pump_delay", "valve_lag", "actuator_stuck")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        component = plant.component(place)
        unit = component.command_unit if isinstance(component, Pump) else "1"
        full = component.max_flow / component.gain if isinstance(component, Pump) else 1.0
        slowest = 120.0 * time_scale(plant) / full
        return (Parameter("slowness", SLOWNESS_UNITS[unit], 0.0, 0.0, slowest, meaning="time to move by one unit"),)

    def remember(self, value: Tensor, p: Values) -> Memory:
        return (value,)

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        gap = memory[0] - value
        needed = torch.abs(gap) * p["slowness"] / clock.step
        moving = torch.clamp(needed, max=1.0)  # share of the step in which it moves
        left = gap * (1.0 - 1.0 / torch.clamp(needed, min=1.0))
        return value + left + 0.5 * moving * (gap - left), (value + left,)
