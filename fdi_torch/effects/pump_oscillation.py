"""A pump or transfer whose delivery oscillates."""

from __future__ import annotations

import math

import torch

from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale


class PumpOscillation(Effect):
    """The flow is q (1 + a sin(2 pi t / T + phi)), averaged over each step: a hunting controller, a worn diaphragm.

    Typical: a of 0.05 to 0.3, T of 10 to 300 s; the tanks filter out faster oscillations.
    """

    name = "pump_oscillation"
    stage = Stage.FLOW
    places = ("pump",)
    searched = False
    mistaken_for = ("sensor_oscillation", "pump_gain")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        scale = time_scale(plant)
        return (
            Parameter("amplitude", "1", 0.0, 0.0, 1.0, meaning="amplitude relative to the flow"),
            Parameter("period", "s", 60.0 * scale, 2.0 * scale, 3600.0 * scale, meaning="period of the oscillation"),
            Parameter("phase", "1", 0.0, -math.pi, math.pi, meaning="phase at t = 0, rad"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        periods = [time_scale(plant) * seconds for seconds in (10.0, 30.0, 60.0, 120.0, 300.0)]
        return [{"amplitude": 0.1, "period": period, "phase": phase} for period in periods for phase in (-1.5, 1.5)]

    def flow(self, flow: torch.Tensor, local: Local, p: Values) -> torch.Tensor:
        return flow * (1.0 + p["amplitude"] * local.clock.sine(p["period"], p["phase"]))
