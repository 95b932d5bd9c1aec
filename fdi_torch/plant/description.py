"""What a rig is made of: tanks, pipes, outlets, pumps and sensors, as plain data in SI.

The physics that reads it is `TankNetwork`. A component's name is a location for faults and unmodelled effects.
A quantity may be given as text with its unit, as in Tank("A", area="200 cm^2", height="60 cm"); a number is SI.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from fdi_torch.parameters import parse_quantity
from fdi_torch.recording import LARGEST as MOST

OUTSIDE = "outside"
COMMAND_UNITS = {"1": "m^3/s", "m^3/s/V": "V", "m^3/s/A": "A", "m^3": "1/s", "m^3/s": "1"}
"""Unit of a pump's gain -> SI unit of its command: a flow, volts, amperes, revolutions or cycles, a share (duty)."""
READING_UNITS = {"1": "m", "Pa/m": "Pa", "V/m": "V", "A/m": "A", "1/m": "1"}
"""Unit of a sensor's gain -> SI unit of its reading."""
MOST_DISCHARGE = 10.0
"""A larger discharge coefficient is no orifice's, effective or not, but per cent without their sign."""


SMALLEST, LARGEST = 1e-12, 1e9
"""Between these, in SI, lies every area, height and flow of a rig: beyond is a slip of the unit or the exponent."""


def _of(unit: str, **given: Any) -> Any:
    """A field that holds a quantity of that unit."""
    return field(metadata={"unit": unit}, **given)


class Component:
    """A part of a rig. Where a field that has a unit is text, such as '200 cm^2', it becomes its SI value.

    Raises ValueError, naming component and field, for text that is no such quantity.
    """

    name: str

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]
            if "unit" in each.metadata:
                self._settle(each.name, [each.metadata["unit"]])

    def _settle(self, field_name: str, units: Sequence[str]) -> str | None:
        """Turns a field into SI by the first unit that its text converts to; returns that, or None for a number."""
        text = getattr(self, field_name)
        if not isinstance(text, str):
            return None
        for unit in units:
            try:
                number = parse_quantity(text, unit)
            except ValueError:
                continue
            if abs(number) <= MOST:
                object.__setattr__(self, field_name, number)
                return unit
        place = f"{type(self).__name__.lower()}s.{self.name}.{field_name}"
        raise ValueError(f"{place}: expected a quantity in {' or '.join(units)}, got '{text}'")


@dataclass(frozen=True)
class Tank(Component):
    """area m^2; height m (the rim); start_level m, or None where it is the equilibrium of the first inputs.

    overflow_to: the tank that catches what runs over the rim, or outside.
    leak_reference: the pipe or outlet whose capacity a leak's size is a share of.
    """

    name: str
    area: float = _of("m^2")
    height: float = _of("m")
    start_level: float | None = _of("m", default=None)
    overflow_to: str = OUTSIDE
    leak_reference: str | None = None

    def __post_init__(self) -> None:
        if self.start_level == "equilibrium":  # as a plant file has it
            object.__setattr__(self, "start_level", None)
        super().__post_init__()


@dataclass(frozen=True)
class Pipe(Component):
    """An orifice from one tank into another tank or the outside.

    area m^2; elevation m above both floors. free_fall: it pours into `target` from above, so that only the
    source's level drives it (always so into the outside). valve: the input channel with its measured opening (0..1);
    unrecorded: its opening in recordings that lack the channel, None where every recording has to have it.
    """

    name: str
    source: str
    target: str
    area: float = _of("m^2")
    discharge_coefficient: float = _of("1")
    elevation: float = _of("m", default=0.0)
    free_fall: bool = False
    valve: str | None = None
    unrecorded: float | None = None

    @property
    def is_outlet(self) -> bool:
        return self.target == OUTSIDE or self.free_fall


@dataclass(frozen=True)
class Pump(Component):
    """Delivers gain x command into `target`, between 0 and max_flow (m^3/s).

    command: the input channel, where that is not its name. gain: m^3/s per SI unit of the command (1 where the command
    is a flow); as text ('2 l/min/V') it tells gain_unit, one of `COMMAND_UNITS`.
    """

    name: str
    target: str
    max_flow: float = _of("m^3/s")
    gain: float = 1.0
    command: str | None = None
    gain_unit: str = "1"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "gain_unit", self._settle("gain", [*COMMAND_UNITS]) or self.gain_unit)

    @property
    def channel(self) -> str:
        return self.command or self.name

    @property
    def command_unit(self) -> str:
        """SI unit of the command."""
        return COMMAND_UNITS[self.gain_unit]


@dataclass(frozen=True)
class Sensor(Component):
    """reading = gain x level + offset, never below low nor above high. unit: SI unit of the reading ('m', 'Pa', 'V',
    'A' or '1'), which a gain as text ('98.1 mbar/m') tells. channel: the output channel, where that is not its name.
    """

    name: str
    tank: str
    unit: str = "m"
    gain: float = 1.0
    offset: float = 0.0
    channel: str | None = None
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        gain_unit = self._settle("gain", [*READING_UNITS])
        if gain_unit is not None:
            object.__setattr__(self, "unit", READING_UNITS[gain_unit])
        for name in ("offset", "low", "high"):
            self._settle(name, [self.unit])

    @property
    def column(self) -> str:
        return self.channel or self.name


@dataclass(frozen=True)
class PlacedEffect:
    """An effect that the plant is believed to have, with its parameters (SI); what `--adopt` adds."""

    effect: str
    location: str
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Matter:
    """What a fault means to who runs the rig. fault: a parameter ('T1.leak.size'). smallest: deviation from nominal
    from which on it is said aloud, SI. urgency: a word of the plant's own, such as high.
    """

    fault: str
    smallest: float = 0.0
    urgency: str = ""


@dataclass(frozen=True)
class PlantDescription:
    """A rig. tolerances: one standard deviation of a constant ('P13.discharge_coefficient'), as a share of it; of an
    offset or of an effect's parameter ('Q1.pump_lag.time_constant'), in its unit. varying: constants that are others
    in each recording, such as the offset of a sensor that is zeroed before each run. matters: which faults a monitor
    says aloud, and how urgent they are.
    """

    name: str
    tanks: tuple[Tank, ...]
    pipes: tuple[Pipe, ...] = ()
    pumps: tuple[Pump, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    effects: tuple[PlacedEffect, ...] = ()
    tolerances: dict[str, float] = field(default_factory=dict)
    varying: tuple[str, ...] = ()
    matters: tuple[Matter, ...] = ()
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
        """All unordered pairs of tanks; the location of an unknown path between two is 'T1-T2'."""
        names = [t.name for t in self.tanks]
        return tuple((a, b) for i, a in enumerate(names) for b in names[i + 1 :])

    def locations(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.components()) + tuple(f"{a}-{b}" for a, b in self.tank_pairs())

    def channels(self) -> tuple[str, ...]:
        """The input channels that a recording must have: pump commands, then valve openings, each once."""
        wanted = [p.channel for p in self.pumps] + [p.valve for p in self.pipes if p.valve]
        return tuple(dict.fromkeys(wanted))

    def channel_units(self) -> dict[str, str]:
        """SI unit of each input channel: of the pump's command, or 1 for a valve's opening."""
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
            known = ", ".join(pipes) or "none there are"
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
        if not pipe.discharge_coefficient <= MOST_DISCHARGE:
            raise ValueError(
                f"{place}.discharge_coefficient: expected at most {MOST_DISCHARGE:g}, got "
                f"{pipe.discharge_coefficient:g}; is it in per cent?"
            )
        if pipe.unrecorded is not None and not 0 <= pipe.unrecorded <= 1:
            raise ValueError(f"{place}.unrecorded: expected an opening from 0 to 1, got {pipe.unrecorded:g}")
        if not 0 <= pipe.elevation <= LARGEST:
            raise ValueError(
                f"plant {plant.name}: pipes.{pipe.name}.elevation: expected a height above both floors, got "
                f"{pipe.elevation:g} m; shift the zero of its tanks"
            )
    for sensor in plant.sensors:
        place = f"plant {plant.name}: sensors.{sensor.name}"
        if sensor.gain == 0:
            raise ValueError(f"{place}.gain: expected a number other than 0, got 0")
        if sensor.low is not None and sensor.high is not None and not sensor.low < sensor.high:
            raise ValueError(
                f"{place}: expected low < high, got {sensor.low:g} and {sensor.high:g} {sensor.unit}; swap them"
            )


def describe(component: Any) -> str:
    """'tank T1', 'pipe P13' ...: a component in words."""
    kind = "outlet" if isinstance(component, Pipe) and component.is_outlet else type(component).__name__.lower()
    return f"{kind} {component.name}"
