"""A sensor that cannot read below some level."""

from __future__ import annotations

import torch

from fdi_torch.effects.clipping import ReadingLimit, clipping_bias
from fdi_torch.plant.effect import Clock, Memory, Values


class SensorFloor(ReadingLimit):
    """max(y, y_min), before noise: a sensor above the floor that falls dry. The nominal limit is far below the range,
    where the effect is absent. If the noise is clipped with the level, the reading is the mean of max(y + e, y_min), as
    in `sensor_saturation`.

    Typical: 1 to 10 % of the range. No effect above the limit.
    """

    name = "sensor_floor"
    upper = False
    searched = False
    mistaken_for = ("sensor_bias", "outlet_drop", "sensor_curvature")

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return torch.maximum(value, p["limit"]) + clipping_bias(p["limit"] - value, p), memory
