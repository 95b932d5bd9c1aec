"""A sensor that follows the level with a first-order lag."""

from __future__ import annotations

import torch

from fdi_torch.plant.effect import Clock, Effect, Memory, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.scales import time_scale


class SensorLag(Effect):
    """tau dv/dt = y - v, exact for a reading that is linear between samples with slope s: v_1 = y_1 - s tau (1 -
    exp(-dt/tau)) + (v_0 - y_0) exp(-dt/tau).

    Typical: tau of 2 to 30 s. Nearly the same as a delay of tau, because levels move slowly.
    """

    name = "sensor_lag"
    stage = Stage.READING
    places = ("sensor",)
    memory = 2
    mistaken_for = ("sensor_delay", "pump_lag", "sensor_hysteresis")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        slowest = 60.0 * time_scale(plant)
        return (Parameter("time_constant", "s", 0.0, 0.0, slowest, meaning="time to 63 % of a step"),)

    def steady_memory(self, value: torch.Tensor, p: Values) -> Memory:
        return value, value

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        last_output, last_input = memory
        decay = clock.decay(p["time_constant"])
        slope_lag = (value - last_input) * (p["time_constant"] / clock.step) * (1.0 - decay)
        lagged = value - slope_lag + (last_output - last_input) * decay
        return lagged, (lagged, value)
