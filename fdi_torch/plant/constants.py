"""The constants of a plant that can be estimated: one Parameter for each constant of each component."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fdi_torch.parameters import Parameter, ParameterName
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Sensor
from fdi_torch.plant.flow_component import FlowComponent


def constant_parameters(plant: PlantDescription) -> Iterator[Parameter]:
    """Every constant of the plant as a Parameter.

    The standard deviation comes from the plant's tolerances (infinite where there is none). A constant that must be
    positive may vary from a tenth to ten times its nominal value. Raises ValueError for a tolerance of an unknown name.
    """
    tolerances = {name: std for name, std in plant.tolerances.items() if ParameterName.parse(name).is_constant}
    for tank in plant.tanks:
        yield _positive(tank.name, "area", "m^2", tank.area, tolerances)
        yield _positive(tank.name, "height", "m", tank.height, tolerances)
        start = 0.5 * tank.height if tank.start_level is None else tank.start_level
        low, high = min(0.0, start), max(tank.height, start)
        name = f"{tank.name}.start_level"
        std = tolerances.pop(name, math.inf)  # absolute, m
        yield Parameter(name, "m", start, low, high, std, "level at t = 0")
        capacity = nominal_capacity(plant, leak_pipe(plant, tank.name))
        yield Parameter(
            f"{tank.name}.leak_capacity", "m^2.5/s", capacity, meaning="flow of a leak of size 1 at 1 m of head"
        )
    for component in plant.flow_components():
        for name, unit, role in component.constants():
            value = getattr(component, name)
            if role == "estimated":
                yield _positive(component.name, name, unit, value, tolerances)
            else:
                meaning = f"{name} of the {component.place_kind}"
                yield Parameter(f"{component.name}.{name}", unit, value, meaning=meaning)
    for sensor in plant.sensors:
        gain_unit = "1" if sensor.unit == "m" else f"{sensor.unit}/m"
        name, scale = f"{sensor.name}.gain", abs(sensor.gain)
        std = tolerances.pop(name, math.inf) * scale
        yield Parameter(
            name, gain_unit, sensor.gain, sensor.gain - 9 * scale, sensor.gain + 9 * scale, std, "gain of the sensor"
        )
        offset = f"{sensor.name}.offset"
        yield Parameter(
            offset, sensor.unit, sensor.offset, std=tolerances.pop(offset, math.inf), meaning="offset of the sensor"
        )
    yield Parameter("gravity", "m/s^2", plant.gravity, 0.0)
    if tolerances:
        raise ValueError(f"{plant.title}: tolerances: expected constants of the plant, got {', '.join(tolerances)}")


def _positive(component: str, field: str, unit: str, value: float, tolerances: dict[str, float]) -> Parameter:
    name = f"{component}.{field}"
    std = tolerances.pop(name, math.inf) * value
    return Parameter(name, unit, value, 0.1 * value, 10.0 * value, std, f"{field.replace('_', ' ')} of {component}")


def leak_pipe(plant: PlantDescription, tank: str) -> Pipe:
    """The pipe or outlet that defines a leak of size 1: the tank's `leak_reference`, else the first one that begins or
    ends at the tank, else the plant's first one.
    """
    reference = plant.tank(tank).leak_reference
    attached = [p for p in plant.pipes if p.name == reference or (reference is None and tank in (p.source, p.target))]
    if attached:
        return attached[0]
    # A plant without pipes: the reference is a hole of a thousandth of the floor's area.
    return plant.pipes[0] if plant.pipes else Pipe(f"{tank}.hole", tank, OUTSIDE, 1e-3 * plant.tank(tank).area, 0.6)


def share_of_hole(plant: PlantDescription, tank: str, outlet: str) -> float:
    """Nominal capacity of an outlet relative to that of a leak of size 1 of its tank."""
    pipe = next(p for p in plant.pipes if p.name == outlet)
    return nominal_capacity(plant, pipe) / nominal_capacity(plant, leak_pipe(plant, tank))


def nominal_capacity(plant: PlantDescription, pipe: Pipe) -> float:
    """Nominal C_d a sqrt(2 g) of a pipe: its flow at 1 m of head, m^2.5/s."""
    return pipe.nominal_capacity(plant.gravity)


def inverse_areas(plant: PlantDescription, component: FlowComponent) -> float:
    """Sum of 1/A over the tanks at both ends, 1/m^2: d(head)/dt per unit of the component's flow."""
    areas = {tank.name: tank.area for tank in plant.tanks}
    return sum(1.0 / areas[end] for end in (component.source, component.target) if end in areas)


def source_height(plant: PlantDescription, pipe: str) -> float:
    """Height of the tank from which the pipe draws, m."""
    return plant.tank(plant.flow(pipe).source).height


def flow_scale(plant: PlantDescription, tank: str) -> float:
    """Characteristic flow of a tank: outflow of the full tank through its leak reference, C sqrt(H), m^3/s."""
    return nominal_capacity(plant, leak_pipe(plant, tank)) * math.sqrt(plant.tank(tank).height)


def reading_at(plant: PlantDescription, sensor: Sensor, share: float) -> float:
    """The reading at a level of `share` times the tank's height, in the sensor's unit."""
    return sensor.gain * share * plant.tank(sensor.tank).height + sensor.offset


def reading_span(plant: PlantDescription, sensor: Sensor) -> float:
    """Absolute change of the reading between an empty and a full tank, in the sensor's unit."""
    return abs(reading_at(plant, sensor, 1.0) - sensor.offset)
