"""PlantDescription: a rig as plain data in SI, and the checks of its names, references and numbers.

`TankNetwork` holds the physics. A component's name is also a location for faults and unmodelled effects.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from fdi_torch.plant.components import (
    COMMAND_UNITS,
    OUTSIDE,
    READING_UNITS,
    Pipe,
    Pump,
    Sensor,
    Tank,
    describe,
)

__all__ = [
    "COMMAND_UNITS",
    "OUTSIDE",
    "READING_UNITS",
    "FaultPriority",
    "Pipe",
    "PlacedEffect",
    "PlantDescription",
    "Pump",
    "Sensor",
    "Tank",
    "describe",
]

LARGEST_DISCHARGE_COEFFICIENT = 10.0
"""Orifices have about 0.6 and wide pipes somewhat more; a larger number is probably in per cent."""
SMALLEST, LARGEST = 1e-12, 1e9
"""Range of every plausible area, height and flow of a rig, SI; a number outside has a wrong unit or exponent."""


@dataclass(frozen=True)
class PlacedEffect:
    """A known effect of the plant, with its parameters (SI); `fdi gap --adopt` adds these."""

    effect: str
    location: str
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class FaultPriority:
    """The importance of a fault to the operators of the rig.

    fault: its size parameter ('T1.leak.size'). smallest: least deviation from nominal that the monitor reports, SI.
    urgency: a free word such as high.
    """

    fault: str
    smallest: float = 0.0
    urgency: str = ""


@dataclass(frozen=True)
class PlantDescription:
    """A rig: its components, known effects and prior knowledge; gravity m/s^2.

    tolerances: prior standard deviations, of a constant ('P13.discharge_coefficient') relative to its value, of an
    offset, a start level or an effect's parameter ('Q1.pump_lag.time_constant') in its unit. varying: constants that
    differ between recordings, such as the offset of a sensor that is zeroed before each run. matters: least
    reported size and urgency of single faults; the monitor reports any other fault at any size.
    """

    name: str
    tanks: tuple[Tank, ...]
    pipes: tuple[Pipe, ...] = ()
    pumps: tuple[Pump, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    effects: tuple[PlacedEffect, ...] = ()
    tolerances: dict[str, float] = field(default_factory=dict)
    varying: tuple[str, ...] = ()
    matters: tuple[FaultPriority, ...] = ()
    gravity: float = 9.81

    def __post_init__(self) -> None:
        _check_names(self)
        _check_references(self)
        _check_numbers(self)

    def components(self) -> Iterator[Tank | Pipe | Pump | Sensor]:
        yield from self.tanks
        yield from self.pipes
        yield from self.pumps
        yield from self.sensors

    def component(self, name: str) -> Tank | Pipe | Pump | Sensor:
        for component in self.components():
            if component.name == name:
                return component
        raise ValueError(f"plant {self.name}: expected one of {', '.join(self.locations())}, got {name}")

    def tank_pairs(self) -> tuple[tuple[str, str], ...]:
        """All unordered pairs of tanks; the location of an effect between two tanks is 'T1-T2'."""
        names = [t.name for t in self.tanks]
        return tuple((a, b) for i, a in enumerate(names) for b in names[i + 1 :])

    def locations(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.components()) + tuple(f"{a}-{b}" for a, b in self.tank_pairs())

    def channels(self) -> tuple[str, ...]:
        """The required input channels of a recording: pump commands, then valve openings, without repetition."""
        channels = [p.channel for p in self.pumps] + [p.valve for p in self.pipes if p.valve]
        return tuple(dict.fromkeys(channels))

    def channel_units(self) -> dict[str, str]:
        """SI unit of each input channel: the unit of the pump's command, or 1 for a valve's opening."""
        units = {p.valve: "1" for p in self.pipes if p.valve} | {p.channel: p.command_unit for p in self.pumps}
        return {channel: units[channel] for channel in self.channels()}


def _check_names(plant: PlantDescription) -> None:
    if not plant.tanks:
        raise ValueError(f"plant {plant.name}: expected at least one tank, got none; add one under tanks")
    seen: set[str] = {OUTSIDE}
    for component in plant.components():
        if component.name in seen:
            raise ValueError(f"plant {plant.name}: expected each name once, got '{component.name}' twice; rename one")
        seen.add(component.name)


def _check_references(plant: PlantDescription) -> None:
    tanks = [t.name for t in plant.tanks]

    def expect_tank(place: str, name: str, also: tuple[str, ...] = ()) -> None:
        if name not in (*tanks, *also):
            known = ", ".join((*tanks, *also))
            raise ValueError(f"plant {plant.name}: {place}: expected one of the tanks {known}, got '{name}'")

    for pipe in plant.pipes:
        expect_tank(f"pipes.{pipe.name}.source", pipe.source)
        expect_tank(f"pipes.{pipe.name}.target", pipe.target, (OUTSIDE,))
        if pipe.source == pipe.target:
            raise ValueError(
                f"plant {plant.name}: pipes.{pipe.name}: expected two different ends, got {pipe.source} twice"
            )
    for pump in plant.pumps:
        expect_tank(f"pumps.{pump.name}.target", pump.target)
    for sensor in plant.sensors:
        expect_tank(f"sensors.{sensor.name}.tank", sensor.tank)
    for tank in plant.tanks:
        expect_tank(f"tanks.{tank.name}.overflow_to", tank.overflow_to, (OUTSIDE,))
        pipes = [p.name for p in plant.pipes]
        if tank.leak_reference is not None and tank.leak_reference not in pipes:
            known = ", ".join(pipes) or "(the plant has none)"
            raise ValueError(
                f"plant {plant.name}: tanks.{tank.name}.leak_reference: expected one of the pipes {known}, "
                f"got '{tank.leak_reference}'"
            )


def _check_numbers(plant: PlantDescription) -> None:
    positive = [
        (f"tanks.{t.name}.{f}", getattr(t, f), u) for t in plant.tanks for f, u in (("area", "m^2"), ("height", "m"))
    ]
    positive += [(f"pipes.{p.name}.area", p.area, "m^2") for p in plant.pipes]
    positive += [(f"pipes.{p.name}.discharge_coefficient", p.discharge_coefficient, "") for p in plant.pipes]
    positive += [(f"pumps.{p.name}.max_flow", p.max_flow, "m^3/s") for p in plant.pumps]
    positive += [("gravity", plant.gravity, "m/s^2")]
    for field_name, value, unit in positive:
        if not value > 0:
            raise ValueError(
                f"plant {plant.name}: {field_name}: expected a positive number, got {value} {unit}".rstrip()
            )
        if not SMALLEST <= value <= LARGEST:
            raise ValueError(
                f"plant {plant.name}: {field_name}: expected {SMALLEST:g} to {LARGEST:g} {unit}, got {value:g}; "
                "is its unit right?"
            )
    for pipe in plant.pipes:
        place = f"plant {plant.name}: pipes.{pipe.name}"
        if not pipe.discharge_coefficient <= LARGEST_DISCHARGE_COEFFICIENT:
            raise ValueError(
                f"{place}.discharge_coefficient: expected at most {LARGEST_DISCHARGE_COEFFICIENT:g}, got "
                f"{pipe.discharge_coefficient:g}; is it in per cent?"
            )
        if pipe.unrecorded is not None and not 0 <= pipe.unrecorded <= 1:
            raise ValueError(f"{place}.unrecorded: expected an opening from 0 to 1, got {pipe.unrecorded:g}")
        if not 0 <= pipe.elevation <= LARGEST:
            raise ValueError(
                f"plant {plant.name}: pipes.{pipe.name}.elevation: expected at least 0 m above both floors, got "
                f"{pipe.elevation:g} m; move the zero of the tanks' levels below the pipe"
            )
    for sensor in plant.sensors:
        place = f"plant {plant.name}: sensors.{sensor.name}"
        if sensor.gain == 0:
            raise ValueError(f"{place}.gain: expected a number other than 0, got 0")
        if sensor.low is not None and sensor.high is not None and not sensor.low < sensor.high:
            raise ValueError(
                f"{place}: expected low < high, got {sensor.low:g} and {sensor.high:g} {sensor.unit}; swap them"
            )
