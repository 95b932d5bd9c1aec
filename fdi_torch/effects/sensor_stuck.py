"""A sensor that is stuck."""

from __future__ import annotations

import torch

from fdi_torch.effects.stuck import Stuck
from fdi_torch.plant.effect import Clock, Memory, Stage, Values


class SensorStuck(Stuck):
    """From the onset on, the sensor holds its last reading (Isermann, 2006, "Fault-Diagnosis Systems", ch. 5).

    size: 1 for fully stuck, 0 for free; in between, the share of the level's change that is lost. Noise that is added
    after the sensor remains.
    """

    name = "sensor_stuck"
    stage = Stage.READING
    places = ("sensor",)
    mistaken_for = ("sensor_gain", "sensor_curvature", "sensor_saturation", "sensor_hysteresis")

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return self.hold(value, memory, clock.risen_by_end(p["onset"], clock.step * 0.0), p)
