"""A pump or valve that no longer moves."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.effects.stuck import Stuck
from fdi_torch.plant.effect import Memory, Stage, Values
from fdi_torch.plant.signals import Clock


class ActuatorStuck(Stuck):
    """From an onset on it stays where it then is (Isermann, 2006, "Fault-Diagnosis Systems", ch. 5).

    size: 1 where it is stuck, 0 where it follows; between them the share of its stroke that is lost. A recording must
    go on with a moving command, or nothing shows.
    """

    name = "actuator_stuck"
    stage = Stage.COMMAND
    places = ("pump", "valve")
    mistaken_for = ("pump_gain", "pump_saturation", "valve_dead_zone", "valve_leak", "actuator_slew")

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        return self.held(value, memory, clock.share_after(p["onset"]), p)
