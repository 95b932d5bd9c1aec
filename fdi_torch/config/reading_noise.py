"""Noise of readings, as one short text for all sensors or for each of them."""

from __future__ import annotations

from fdi_torch.names import unknown
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.quantities import parse_quantity


def reading_noise(text: str, plant: PlantDescription) -> list[float]:
    """Standard deviation of each sensor's readings in its SI unit.

    '1 mm' refers to the level, for sensors of any unit; '0.01 mA' is for plants with current sensors only; 'p1 = 2 mV,
    h2 = 1 mm' names each sensor. Raises ValueError.
    """
    if "=" not in text:
        return [_std(text, sensor) for sensor in plant.sensors]
    given = {name.strip(): amount.strip() for name, _, amount in (part.partition("=") for part in text.split(","))}
    names = [sensor.name for sensor in plant.sensors]
    for name in given:
        if name not in names:
            raise ValueError(f"noise: {unknown('a sensor', name, names)}")
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(f"noise: expected one for each of {', '.join(names)}, got none for {', '.join(missing)}")
    return [_std(given[sensor.name], sensor) for sensor in plant.sensors]


def _std(text: str, sensor: Sensor) -> float:
    try:
        std = parse_quantity(text, sensor.unit)
    except ValueError:
        try:
            std = parse_quantity(text, "m") * abs(sensor.gain)
        except ValueError:
            raise ValueError(
                f"noise of {sensor.name}: expected a standard deviation of the reading ({sensor.unit}) or of the "
                f"level, with a unit such as '1 mm', got '{text}'"
            ) from None
    if not std > 0:
        raise ValueError(f"noise of {sensor.name}: expected a positive standard deviation, got '{text}'")
    return std
