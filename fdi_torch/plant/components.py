"""Tanks and sensors as plain data in SI, and the base of all components; `plant.kinds` holds the flow components.

A quantity may be given as text with its unit, as in Tank("A", area="200 cm^2", height="60 cm"); a number is SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import torch

from fdi_torch.quantities import parse_quantity, quantity_text
from fdi_torch.recording import LARGEST as LARGEST_QUANTITY

OUTSIDE = "outside"
COMMAND_UNITS = {"1": "m^3/s", "m^3/s/V": "V", "m^3/s/A": "A", "m^3": "1/s", "m^3/s": "1"}
"""Unit of a pump's gain -> SI unit of its command: a flow, volts, amperes, revolutions or strokes, or a duty cycle."""
READING_UNITS = {"1": "m", "Pa/m": "Pa", "V/m": "V", "A/m": "A", "1/m": "1"}
"""Unit of a sensor's gain -> SI unit of its reading."""


def quantity_field(
    unit: str,
    meaning: str,
    *,
    role: str = "",
    least: float | None = None,
    most: float | None = None,
    none: str | None = None,
    **given: Any,
) -> Any:
    """A dataclass field that holds a quantity of that unit.

    meaning: of its key in a plant file. role: 'estimated' for a positive constant that can be estimated and have a
    relative tolerance, 'constant' for one that simulations may change and
    that is never estimated. least, most: the values that a file may have.
    none: the word for None. given: further arguments of `dataclasses.field`.
    """
    metadata = {"unit": unit, "meaning": meaning, "role": role, "least": least, "most": most, "none": none}
    return field(metadata=metadata, **given)


def word_field(meaning: str, **given: Any) -> Any:
    """A dataclass field that holds a name or a flag. written_default: its default in plant files only."""
    metadata = {"meaning": meaning}
    if "written_default" in given:
        metadata["written_default"] = given.pop("written_default")
    return field(metadata=metadata, **given)


class Component:
    """Base of the component classes; converts text such as '200 cm^2' in a field with a unit to its SI value.

    Raises ValueError, naming component and field, for text that is not a quantity in that unit.
    """

    name: str

    @property
    def place_kind(self) -> str:
        """The kind of place that it is for effects, such as 'tank', 'pipe', 'outlet'."""
        return type(self).__name__.lower()

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]
            if "unit" in each.metadata:
                if getattr(self, each.name) == each.metadata["none"]:
                    object.__setattr__(self, each.name, None)
                self._convert(each.name, [each.metadata["unit"]])

    @property
    def written(self) -> dict[str, str]:
        """Quantities that were given as text, by field; a copy of the component has none."""
        texts: dict[str, str] = self.__dict__.setdefault("_written", {})
        return texts

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
                self.written[field_name] = text
                return unit
        place = f"{type(self).__name__.lower()}s.{self.name}.{field_name}"
        raise ValueError(f"{place}: expected a quantity in {' or '.join(units)}, got '{text}'")


@dataclass(frozen=True)
class Tank(Component):
    """A tank with vertical walls: area m^2; height of the rim above the floor, m.

    start_level: level at t = 0, m; None for the equilibrium under the first inputs. overflow_to: the tank that
    receives the overflow, or outside. leak_reference: the pipe or outlet whose capacity is a leak of size 1; None for
    the first pipe of the plant that begins or ends at the tank (see `plant.constants.leak_pipe`).
    """

    name: str
    area: float = quantity_field("m^2", "cross-section, m^2")
    height: float = quantity_field("m", "from the floor to the rim, m")
    start_level: float | None = quantity_field(
        "m", "level at t = 0, m, or equilibrium (of the first inputs)", none="equilibrium", default=None
    )
    overflow_to: str = word_field("the tank that receives the overflow", default=OUTSIDE)
    leak_reference: str | None = word_field(
        "the pipe whose capacity is a leak of size 1; by default the first one at the tank", default=None
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if "start_level" in self.written:
            self.check_level(self.start_level, f"tanks.{self.name}.start_level")

    def check_level(self, level: float | None, place: str) -> None:
        """Raise ValueError, naming `place`, for an initial level (m) below the floor or above the rim."""
        if level is not None and not 0.0 <= level <= self.height:
            rim, given = quantity_text(self.height, "m"), quantity_text(level, "m")
            raise ValueError(f"{place}: expected a level from the floor to {rim}, got {given}")


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

    def clipped(self, reading: torch.Tensor) -> torch.Tensor:
        """The reading limited to low..high."""
        return reading if self.low is None and self.high is None else torch.clamp(reading, self.low, self.high)
