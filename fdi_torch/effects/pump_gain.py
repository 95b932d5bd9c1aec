"""A pump or transfer that delivers more or less than its nominal flow."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import timed_starts


class PumpGain(Effect):
    """The flow is k times the nominal one from an onset on, at once or over a ramp (loss of effectiveness; Zhang and
    Jiang, 2008, "Bibliographical review on reconfigurable fault-tolerant control systems").

    Typical: k of 0.7 to 1.2. The same as an offset, a dead zone or a constant draw while the command hardly moves.
    """

    name = "pump_gain"
    stage = Stage.FLOW
    places = ("pump",)
    instants = ("onset",)
    mistaken_for = (
        "actuator_stuck",
        "pump_saturation",
        "pump_back_pressure",
        "pump_dead_zone",
        "pump_offset",
        "pump_curve",
    )

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("factor", "1", 1.0, 0.0, 2.0, meaning="delivered / nominal flow", extremes=(0.0,)),
            Parameter("onset", "s", 0.0, 0.0, meaning="time at which it begins"),
            Parameter("ramp", "s", 0.0, 0.0, meaning="time until full size"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        return timed_starts([{"factor": 0.9}, {"factor": 1.1}], operating_range)

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * (1.0 + (p["factor"] - 1.0) * local.clock.risen(p["onset"], p["ramp"]))
