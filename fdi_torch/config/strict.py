"""The base of all configuration models: unknown keys are errors, and quantities have units."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Annotated, Any, TypeVar

from pydantic import AllowInfNan, BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic.fields import FieldInfo

from fdi_torch.config.problems import UnknownKeyError, naming, shown
from fdi_torch.names import unknown
from fdi_torch.quantities import display_unit, parse_quantity
from fdi_torch.recording import LARGEST


class Strict(BaseModel):
    """A mapping with known keys only. Field descriptions state the meaning of each key, with its unit."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        return with_known_keys(data, [field.alias or name for name, field in cls.model_fields.items()])


def with_known_keys(data: Any, known: Collection[str]) -> Any:
    """The data. Raises UnknownKeyError if it is a mapping with another key."""
    for key in data if isinstance(data, dict) else ():
        if key not in known:
            raise UnknownKeyError(unknown("a known key", str(key), known), str(key))
    return data


def quantity(value: Any, unit: str) -> float:
    """'160 cm^2' -> 0.016 for unit 'm^2'. A number without unit is accepted only for the unit '1'.

    Raises ValueError for anything that is not a finite quantity in that unit.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"expected a quantity in {unit}, got {shown(value)}")
    if isinstance(value, str):
        number = parse_quantity(value, unit)
    elif unit == "1":
        number = float(value)
    else:
        usual, _ = display_unit(unit)
        raise ValueError(f"expected a quantity in {unit}, got the bare number {value}; write its unit, such as {usual}")
    if not abs(number) <= LARGEST:
        raise ValueError(f"expected a quantity in {unit} within {LARGEST:g}, got {value}")
    return number


def quantity_at(place: str, value: Any, unit: str) -> float:
    """As `quantity`; an error names the place of the value."""
    with naming(place):
        return quantity(value, unit)


def _held(value: Any) -> float:
    return math.inf if value == "always" else quantity(value, "s")


def quantity_of(unit: str) -> tuple[BeforeValidator, Any]:
    """The validators of a quantity in that unit, for `Annotated`."""
    return BeforeValidator(lambda value: quantity(value, unit)), Field(json_schema_extra={"unit": unit})


Share = Annotated[float, *quantity_of("1")]
Length = Annotated[float, *quantity_of("m")]
Seconds = Annotated[float, *quantity_of("s")]
HeldFor = Annotated[float, AllowInfNan(True), BeforeValidator(_held)]
"""A time, s, or always."""
Decibel = Annotated[float, Field(ge=-300, le=300)]
_SCALED = "the default is for three_tank"
ScaledSeconds = Annotated[Seconds, _SCALED]
ScaledSteps = Annotated[list[Seconds], _SCALED]
Acceleration = Annotated[float, *quantity_of("m/s^2")]

Amount = float | str
"""A quantity whose unit depends on its owner; converted to SI once that is known."""


Config = TypeVar("Config", bound=Strict)


def is_scaled(field: FieldInfo) -> bool:
    """Whether the default is multiplied by the plant's time scale."""
    return _SCALED in field.metadata


def scaled_to_plant(config: Config, scale: float) -> Config:
    """The configuration with all default times for three_tank multiplied by the plant's time scale."""
    changes: dict[str, Any] = {}
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if isinstance(value, Strict):
            changes[name] = scaled_to_plant(value, scale)
        elif is_scaled(field) and name not in config.model_fields_set:
            changes[name] = [scale * v for v in value] if isinstance(value, list) else scale * value
    return config.model_copy(update=changes) if scale != 1.0 else config
