"""A sensor with a coarse resolution."""

from __future__ import annotations

import torch

from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.effect import Effect, OperatingRange, Parameter, PlantDescription, Stage, Values


class SensorQuantization(Effect):
    """The noisy reading is rounded to multiples of a step (Widrow and Kollar, 2008, "Quantization Noise"). This effect
    passes the noise-free reading unchanged: the simulation rounds after it adds noise, and a likelihood integrates over
    the interval that rounds to the reading, with the step from `resolution`.

    Typical: 0.1 to 2 % of the range. Adds noise of step / sqrt(12) if the noise is wider than the step.
    """

    name = "sensor_quantization"
    stage = Stage.READING
    places = ("sensor",)
    smooth = False
    quantizes = True
    mistaken_for = ("sensor_hysteresis",)

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.sensor(place)
        step = 0.1 * reading_span(plant, sensor)
        return (Parameter("step", sensor.unit, 0.0, 0.0, step, meaning="resolution of the reading"),)

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        sensor = plant.sensor(place)
        return [{"step": share * reading_span(plant, sensor)} for share in (0.001, 0.003, 0.01, 0.03)]

    def resolution(self, p: Values) -> torch.Tensor:
        return p["step"]
