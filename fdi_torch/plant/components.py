"""Components of a rig: tanks, pipes, outlets, pumps and sensors, as plain data in SI.

A quantity may be given as text with its unit, as in Tank("A", area="200 cm^2", height="60 cm"); a number is SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from fdi_torch.parameters import parse_quantity
from fdi_torch.recording import LARGEST as LARGEST_QUANTITY

OUTSIDE = "outside"
COMMAND_UNITS = {"1": "m^3/s", "m^3/s/V": "V", "m^3/s/A": "A", "m^3": "1/s", "m^3/s": "1"}
"""Unit of a pump's gain -> SI unit of its command: a flow, volts, amperes, revolutions or strokes, or a duty cycle."""
READING_UNITS = {"1": "m", "Pa/m": "Pa", "V/m": "V", "A/m": "A", "1/m": "1"}
"""Unit of a sensor's gain -> SI unit of its reading."""


def _quantity(unit: str, **arguments: Any) -> Any:
    """A dataclass field that holds a quantity of that unit."""
    return field(metadata={"unit": unit}, **arguments)


class Component:
    """Base of the component classes; converts text such as '200 cm^2' in a field with a unit to its SI value.

    Raises ValueError, naming component and field, for text that is not a quantity in that unit.
    """

    name: str

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]
            if "unit" in each.metadata:
                self._convert(each.name, [each.metadata["unit"]])

    def _convert(self, field_name: str, units: Sequence[str]) -> str | None:
        """Convert a text field to SI by the first unit that fits; return that unit, or None for a number."""
        text = getattr(self, field_name)
        if not isinstance(text, str):
            return None
        for unit in units:
            try:
                number = parse_quantity(text, unit)
            except ValueError:
                continue
            if abs(number) <= LARGEST_QUANTITY:
                object.__setattr__(self, field_name, number)
                return unit
        place = f"{type(self).__name__.lower()}s.{self.name}.{field_name}"
        raise ValueError(f"{place}: expected a quantity in {' or '.join(units)}, got '{text}'")


@dataclass(frozen=True)
class Tank(Component):
    """A tank with vertical walls: area m^2; height of the rim above the floor, m.

    start_level: level at t = 0, m; None for the equilibrium under the first inputs. overflow_to: the tank that
    receives the overflow, or outside. leak_reference: the pipe or outlet whose capacity is a leak of size 1.
    """

    name: str
    area: float = _quantity("m^2")
    height: float = _quantity("m")
    start_level: float | None = _quantity("m", default=None)
    overflow_to: str = OUTSIDE
    leak_reference: str | None = None

    def __post_init__(self) -> None:
        if self.start_level == "equilibrium":  # the word for None in a plant file
            object.__setattr__(self, "start_level", None)
        super().__post_init__()


@dataclass(frozen=True)
class Pipe(Component):
    """An orifice from one tank into another tank or to the outside: area m^2; elevation m above both floors.

    free_fall: whether it pours into `target` from above, so that only the source's level drives it (always true of an
    outlet to the outside). valve: the input channel with the measured opening (0..1) of its valve. unrecorded: the
    opening in recordings without that channel; None requires the channel in every recording.
    """

    name: str
    source: str
    target: str
    area: float = _quantity("m^2")
    discharge_coefficient: float = _quantity("1")
    elevation: float = _quantity("m", default=0.0)
    free_fall: bool = False
    valve: str | None = None
    unrecorded: float | None = None

    @property
    def is_outlet(self) -> bool:
        return self.target == OUTSIDE or self.free_fall


@dataclass(frozen=True)
class Pump(Component):
    """A pump that delivers gain x command into `target`, limited to 0..max_flow (m^3/s).

    command: the input channel, if its name differs from the pump's. gain: m^3/s per SI unit of the command (1 if the
    command is a flow); a gain given as text ('2 l/min/V') sets gain_unit, one of `COMMAND_UNITS`.
    """

    name: str
    target: str
    max_flow: float = _quantity("m^3/s")
    gain: float = 1.0
    command: str | None = None
    gain_unit: str = "1"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "gain_unit", self._convert("gain", [*COMMAND_UNITS]) or self.gain_unit)

    @property
    def channel(self) -> str:
        return self.command or self.name

    @property
    def command_unit(self) -> str:
        """SI unit of the command."""
        return COMMAND_UNITS[self.gain_unit]


@dataclass(frozen=True)
class Sensor(Component):
    """A level sensor: reading = gain x level + offset, limited to low..high.

    unit: SI unit of the reading ('m', 'Pa', 'V', 'A' or '1'); a gain given as text ('98.1 mbar/m') sets it.
    channel: the output channel, if its name differs from the sensor's.
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
        gain_unit = self._convert("gain", [*READING_UNITS])
        if gain_unit is not None:
            object.__setattr__(self, "unit", READING_UNITS[gain_unit])
        for name in ("offset", "low", "high"):
            self._convert(name, [self.unit])

    @property
    def column(self) -> str:
        return self.channel or self.name


def describe(component: Any) -> str:
    """'tank T1', 'outlet OUT2' ...: kind and name of a component."""
    kind = "outlet" if isinstance(component, Pipe) and component.is_outlet else type(component).__name__.lower()
    return f"{kind} {component.name}"
