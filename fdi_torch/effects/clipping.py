"""Base of the sensors with a lower or an upper limit, and the clipping of noisy readings there."""

from __future__ import annotations

import math
from typing import ClassVar

import torch

from fdi_torch.plant.constants import reading_at
from fdi_torch.plant.effect import Effect, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import interior_points

LOGISTIC = math.sqrt(3.0) / math.pi  # scale of a logistic noise over its standard deviation
LEAST = 1e-12
NOISE_MEANING = "standard deviation of the noise that is clipped with the level"


class ReadingLimit(Effect):
    """A limit of the reading, which is absent at its nominal value far outside the sensor's range.

    upper: whether it is the highest reading, or the lowest one. noise: standard deviation of the noise that is clipped
    with the level. behind: share of it that is added after a first limit.
    """

    stage = Stage.READING
    places = ("sensor",)
    smooth = False
    upper: ClassVar[bool]

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.sensor(place)
        outer, inner = (max, min) if self.upper else (min, max)
        absent = outer(reading_at(plant, sensor, share) for share in (-1.0, 2.0))
        furthest = inner(reading_at(plant, sensor, share) for share in (0.0, 1.0))
        low, high = sorted((absent, furthest))
        meaning = f"{'highest' if self.upper else 'lowest'} reading"
        return (
            Parameter("limit", sensor.unit, absent, low, high, meaning=meaning),
            Parameter("noise", sensor.unit, 0.0, 0.0, meaning=NOISE_MEANING),
            Parameter("behind", "1", 0.0, 0.0, 1.0, meaning="share of the noise added after a first limit"),
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        low, high = operating_range.readings[place]
        middle = 0.5 * (low + high)
        half = (middle, high) if self.upper else (low, middle)
        return [{"limit": limit} for limit in interior_points(half, 5)]


def clipping_bias(beyond: torch.Tensor, p: Values) -> torch.Tensor:
    """Distance of the mean of a clipped noisy reading from the clipped level, towards the inside, in the reading's
    unit.

    E[max(x + e, 0)] - max(x, 0) = s log(1 + exp(-|x|/s)) for logistic noise e of scale s; for normal noise of the same
    standard deviation the error is below 2 % of that. `p["behind"]` is the share of the noise that enters between two
    limits (transmitter, then logger); its contribution stays constant beyond the limit. beyond: x, positive outside.
    """
    scale = LOGISTIC * p["noise"]
    positive_scale = torch.clamp(scale, min=LEAST)
    one_limit = torch.log(1.0 + torch.exp(-torch.abs(beyond) / positive_scale))
    two_limits = torch.log(1.0 + torch.exp(torch.clamp(beyond, max=0.0) / positive_scale))
    return scale * (one_limit + p["behind"] * (two_limits - one_limit))


def clipped_noise(depth: float, std: float) -> dict[str, float]:
    """The parameters `noise` and `behind` with which the mean of readings far beyond a limit lies `depth` inside of it.

    std: standard deviation of the readings' noise; a greater one is stated if that is too small for the depth.
    """
    all_behind = max(depth, 0.0) / (LOGISTIC * math.log(2.0))
    noise = max(std, all_behind)
    return {"noise": noise, "behind": all_behind / noise if noise > 0.0 else 0.0}
