"""A sensor that reads in steps."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.parameters import Parameter
from fdi_torch.plant.constants import reading_span
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.effect import Effect, Stage, Values
from fdi_torch.plant.reach import Reach


class SensorQuantization(Effect):
    """The noisy reading is rounded to multiples of a step (Widrow and Kollar, 2008, "Quantization Noise"). The
    reading itself passes unchanged: whoever adds the noise rounds after it, and whoever judges a reading takes the
    probability of the interval that rounds to it, with the step from `resolution`.

    Typical: 0.1 to 2 % of the range. Where the noise is wider than the step it adds a noise of step / sqrt(12).
    """

    name = "sensor_quantization"
    stage = Stage.READING
    places = ("sensor",)
    smooth = False
    rounds = True
    mistaken_for = ("sensor_hysteresis",)

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        step = 0.1 * reading_span(plant, sensor)
        return (Parameter("step", sensor.unit, 0.0, 0.0, step, meaning="distance between two readings"),)

    def starts(self, place: str, plant: PlantDescription, reach: Reach) -> list[dict[str, float]]:
        sensor = plant.component(place)
        assert isinstance(sensor, Sensor)
        return [{"step": share * reading_span(plant, sensor)} for share in (0.001, 0.003, 0.01, 0.03)]

    def resolution(self, p: Values) -> Tensor:
        return p["step"]
