"""A pump or valve that no longer moves."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.reach import Reach, inside
from fdi_torch.plant.signals import Clock


class ActuatorStuck(Effect):
    """From an onset on it stays where it then is (Isermann, 2006, "Fault-Diagnosis Systems", ch. 5).

    size: 1 where it is stuck, 0 where it follows; between them the share of its stroke that is lost. A recording must
    go on with a moving command, or nothing shows.
    """

    name = "actuator_stuck"
    stage = Stage.COMMAND
    places = ("pump", "valve")
    memory = 1
    mistaken_for = ("pump_gain", "pump_saturation", "valve_dead_zone", "valve_leak", "actuator_slew")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "1", 0.0, 0.0, 1.0, meaning="share of its stroke that it has lost"),
            Parameter("onset", "s", 0.0, 0.0, meaning="when it gets stuck"),
        )

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        return [{"size": 0.9, "onset": onset} for onset in (0.0, *inside((0.0, reach.duration), 5))]

    def remember(self, value: Tensor, p: Values) -> Memory:
        return (value,)

    def command(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        share = clock.share_after(p["onset"])
        held = value + share * (memory[0] - value)
        return value + p["size"] * share * (held - value), (held,)
