"""A sensor with a wrong gain."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import timed_starts


class SensorGain(Effect):
    """The reading is k y from an onset on, at once or over a ramp (span error; Isermann, 2006, "Fault-Diagnosis
    Systems", ch. 5).

    Typical: k of 0.9 to 1.1. The same as a bias while the level hardly moves.
    """

    name = "sensor_gain"
    stage = Stage.READING
    places = ("sensor",)
    instants = ("onset",)
    mistaken_for = ("sensor_curvature", "sensor_bias", "sensor_stuck", "laminar_flow")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        return (
            Parameter("factor", "1", 1.0, 0.2, 1.8, meaning="reading / true reading"),
            Parameter("onset", "s", 0.0, 0.0, meaning="time at which it begins"),
            Parameter("ramp", "s", 0.0, 0.0, meaning="time until full size"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        return timed_starts([{"factor": 0.95}, {"factor": 1.05}], operating_range)

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return value * (1.0 + (p["factor"] - 1.0) * clock.risen_by_end(p["onset"], p["ramp"])), memory
