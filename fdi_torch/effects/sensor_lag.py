"""A sensor that follows the level with a lag."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Effect, Memory, Stage, Values
from fdi_torch.plant.pace import time_scale
from fdi_torch.plant.signals import Clock


class SensorLag(Effect):
    """First-order response tau dv/dt = y - v, exact for a reading that runs straight from sample to sample (at the
    rate s): v_1 = y_1 - s tau (1 - exp(-dt/tau)) + (v_0 - y_0) exp(-dt/tau).

    Typical: tau of 2 to 30 s. On levels, which move slowly, nearly the same as a delay of tau.
    """

    name = "sensor_lag"
    stage = Stage.READING
    places = ("sensor",)
    memory = 2
    mistaken_for = ("sensor_delay", "pump_lag", "sensor_hysteresis")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        slowest = 60.0 * time_scale(plant)
        return (Parameter("time_constant", "s", 0.0, 0.0, slowest, meaning="time to 63 % of a step"),)

    def remember(self, value: Tensor, p: Values) -> Memory:
        return value, value

    def reading(self, value: Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[Tensor, Memory]:
        seen, before = memory
        decay = clock.decay(p["time_constant"])
        behind = (value - before) * (p["time_constant"] / clock.step) * (1.0 - decay)
        lagged = value - behind + (seen - before) * decay
        return lagged, (lagged, value)
