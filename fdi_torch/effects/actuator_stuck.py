"""A pump, transfer or valve that is stuck."""

from __future__ import annotations

import torch

from fdi_torch.effects.stuck import Stuck
from fdi_torch.plant.effect import Clock, Memory, Stage, Values


class ActuatorStuck(Stuck):
    """From the onset on, the actuator holds its position: v(t) = v(onset) (Isermann, 2006, "Fault-Diagnosis Systems",
    ch. 5).

    size: 1 for fully stuck, 0 for free; in between, the share of the command's change that is lost. Only a command that
    changes after the onset shows it.
    """

    name = "actuator_stuck"
    stage = Stage.COMMAND
    places = ("pump", "valve")
    searched = False
    mistaken_for = ("pump_gain", "pump_saturation", "valve_dead_zone", "valve_leak", "actuator_slew")

    def command(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return self.hold(value, memory, clock.share_after(p["onset"]), p)
