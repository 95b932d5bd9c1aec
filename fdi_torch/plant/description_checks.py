"""Checks of the names, references and numbers of a plant."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fdi_torch.plant.components import OUTSIDE
from fdi_torch.plant.flow_component import FlowOrder
from fdi_torch.quantities import SI_UNITS, quantity_text

if TYPE_CHECKING:
    from fdi_torch.plant.description import PlantDescription

SMALLEST, LARGEST = 1e-12, 1e9
"""Range of every plausible area, height and flow of a rig, SI; a number outside has a wrong unit or exponent."""


def check_names(plant: PlantDescription) -> None:
    """Raise ValueError for a plant without tanks, or with a name that is used twice."""
    if not plant.tanks:
        raise ValueError(f"{plant.title}: expected at least one tank, got none; add one under tanks")
    names: set[str] = {OUTSIDE}
    for name in plant.locations():
        if name in names:
            raise ValueError(f"{plant.title}: expected each name once, got '{name}' twice; rename one")
        names.add(name)


def check_references(plant: PlantDescription) -> None:
    """Raise ValueError for a component that names a tank or pipe that the plant lacks, or has both ends at one tank."""
    tanks = [t.name for t in plant.tanks]

    def expect_tank(place: str, name: str, also: tuple[str, ...] = ()) -> None:
        if name not in (*tanks, *also):
            known = ", ".join((*tanks, *also))
            raise ValueError(f"{plant.title}: {place}: expected one of the tanks {known}, got '{name}'")

    for component in plant.flow_components():
        place = f"{component.part()}.{component.name}"
        if component.source != OUTSIDE or component.order != FlowOrder.INFLOW:
            expect_tank(f"{place}.source", component.source)
        expect_tank(f"{place}.target", component.target, () if component.source == OUTSIDE else (OUTSIDE,))
        if component.source == component.target:
            raise ValueError(f"{plant.title}: {place}: expected two different ends, got {component.source} twice")
    for sensor in plant.sensors:
        expect_tank(f"sensors.{sensor.name}.tank", sensor.tank)
    for tank in plant.tanks:
        expect_tank(f"tanks.{tank.name}.overflow_to", tank.overflow_to, (OUTSIDE,))
        pipes = [p.name for p in plant.pipes]
        if tank.leak_reference is not None and tank.leak_reference not in pipes:
            known = ", ".join(pipes) or "(the plant has none)"
            raise ValueError(
                f"{plant.title}: tanks.{tank.name}.leak_reference: expected one of the pipes {known}, "
                f"got '{tank.leak_reference}'"
            )


def check_numbers(plant: PlantDescription) -> None:
    """Raise ValueError for a number outside its range."""
    positive = [
        (f"tanks.{t.name}.{f}", getattr(t, f), u) for t in plant.tanks for f, u in (("area", "m^2"), ("height", "m"))
    ]
    for component in plant.flow_components():
        place = f"{component.part()}.{component.name}"
        positive += [(f"{place}.{name}", getattr(component, name), unit) for name, unit in component.positive_fields()]
    positive += [("gravity", plant.gravity, "m/s^2")]
    for field_name, value, unit in positive:
        if not value > 0:
            given = quantity_text(value, unit) if unit in SI_UNITS else f"{value:g} {unit}"
            raise ValueError(f"{plant.title}: {field_name}: expected a positive number, got {given}")
        if not SMALLEST <= value <= LARGEST:
            raise ValueError(
                f"{plant.title}: {field_name}: expected {SMALLEST:g} to {LARGEST:g} {unit}, got {value:g}; "
                "is its unit right?"
            )
    for component in plant.flow_components():
        for problem in component.problems():
            raise ValueError(f"{plant.title}: {component.part()}.{component.name}.{problem}")
    for sensor in plant.sensors:
        place = f"{plant.title}: sensors.{sensor.name}"
        if sensor.gain == 0:
            raise ValueError(f"{place}.gain: expected a number other than 0, got 0")
        if sensor.low is not None and sensor.high is not None and not sensor.low < sensor.high:
            raise ValueError(
                f"{place}: expected low < high, got {sensor.low:g} and {sensor.high:g} {sensor.unit}; swap them"
            )
