"""A sensor that cannot read above some level."""

from __future__ import annotations

import torch

from fdi_torch.effects.clipping import ReadingLimit, clipping_bias
from fdi_torch.plant.effect import Clock, Memory, Values


class SensorSaturation(ReadingLimit):
    """min(y, y_max), before noise. The nominal limit is far above the range, where the effect is absent. If the noise
    is clipped with the level, the reading is the mean of min(y + e, y_max), at the limit 0.4 standard deviations below
    it; the share `behind` of the noise is added after a first limit and lowers the reading beyond the limit too.

    Typical: 60 to 95 % of the range. No effect below the limit. A rig with a known limit has it in the plant file
    (high).
    """

    name = "sensor_saturation"
    upper = True
    mistaken_for = ("overflow", "pump_cut_out", "sensor_curvature")

    def reading(self, value: torch.Tensor, memory: Memory, clock: Clock, p: Values) -> tuple[torch.Tensor, Memory]:
        return torch.minimum(value, p["limit"]) - clipping_bias(value - p["limit"], p), memory
