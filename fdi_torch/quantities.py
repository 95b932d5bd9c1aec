"""Quantities as text: conversion to SI, and the units in which results are displayed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache

from fdi_torch.names import nearest, shortened
from fdi_torch.parameters import common_name
from fdi_torch.units import UnitError, factor, in_unit, is_unit, number_and_unit, same_kind

SI_UNITS = ("m", "s", "V", "Pa", "A", "1/s", "m^2", "m^3", "m^3/s", "m/s", "1")
USUAL_UNITS = {
    "m": ("mm", "cm", "dm", "m", "in", "ft"),
    "s": ("ms", "s", "min", "h", "day"),
    "V": ("mV", "V"),
    "Pa": ("Pa", "hPa", "kPa", "mbar", "bar", "psi"),
    "A": ("mA", "A"),
    "1/s": ("Hz", "1/min", "1/s"),
    "m^2": ("mm^2", "cm^2", "dm^2", "m^2"),
    "m^3": ("ml", "cm^3", "l", "m^3", "gal"),
    "m^3/s": ("ml/min", "ml/s", "cm^3/s", "l/h", "l/min", "l/s", "m^3/h", "m^3/s", "gal/min"),
    "m/s": ("mm/s", "cm/s", "m/s"),
    "1": ("%",),
}
"""Units by SI unit, of which a message names the nearest one to an unknown unit."""
MOST_NAMED = 20  # letters of an unknown unit that is named apart from its quantity
NO_COMMAS = "write 10.5 for decimals, and 10000 without a separator of thousands"


@lru_cache(maxsize=4096)
def parse_quantity(text: str, unit: str) -> float:
    """'160 cm^2' -> 0.016 for unit 'm^2'. A bare number is accepted only for the unit '1'.

    Raises ValueError for text that is not a quantity, or has another dimension.
    """
    try:
        return in_unit(*number_and_unit(text), unit)
    except UnitError:
        expected = "a number or a share such as '30 %'" if unit == "1" else f"a quantity in {unit} such as '1 {unit}'"
        hint = f"; {NO_COMMAS}" if "," in text else _unknown_unit(text, unit)
        raise ValueError(f"expected {expected}, got '{shortened(text)}'{hint}") from None


def _unknown_unit(text: str, si_unit: str) -> str:
    """The end of a message about a quantity whose unit is unknown: '; the unit L/mn is unknown; the nearest is ...'."""
    try:
        _, unit = number_and_unit(text)
    except UnitError:
        return ""
    if len(unit) > MOST_NAMED or is_unit(unit):
        return ""
    return f"; the unit {unit} is unknown{nearest(unit, USUAL_UNITS.get(si_unit, ()))}"


def parse_level_deviation(text: str, name: str) -> float:
    """A standard deviation of levels, m, from text such as '3 mm'.

    Raises ValueError, naming the option `name`, for text that is not a positive length with its unit.
    """
    try:
        value = parse_quantity(text, "m")
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if not value > 0.0:
        raise ValueError(f"{name}: expected a positive standard deviation such as '1 mm', got '{text}'")
    return value


@lru_cache(maxsize=256)
def unit_factor(unit: str, si_unit: str) -> float:
    """The value of one `unit` in `si_unit`: unit_factor('cm', 'm') = 0.01."""
    try:
        return factor(unit, si_unit)
    except UnitError:
        near = "" if is_unit(unit) else nearest(unit, USUAL_UNITS.get(si_unit, ()))
        raise ValueError(f"expected a unit that converts to {si_unit}, got '{shortened(unit)}'{near}") from None


def si_unit_of(unit: str) -> str:
    """The SI unit of a quantity given in `unit`: 'cm3_s' -> 'm^3/s'."""
    si_unit = same_kind(unit, SI_UNITS)
    if si_unit is not None:
        return si_unit
    raise ValueError(
        "expected a unit of level, pressure, flow, time, voltage, current, frequency or share, "
        f"got '{shortened(unit)}'; write for example cm, mbar, cm3_s, V, mA, pct"
    )


def display_unit(si_unit: str, name: str = "") -> tuple[str, float]:
    """The unit for display, and the value of one SI unit in it: 'm' -> ('cm', 100.0).

    It is the unit set by `display_in` for that kind of quantity; name: a channel or a parameter, which may have its
    own. A quotient without a unit of its own is displayed in the units of its parts.
    """
    chosen = _DISPLAYED.get()
    unit = _in_chosen_unit(si_unit, chosen)
    name = common_name(name) if "@" in name else name
    if name in chosen:
        with suppress(ValueError):  # the channel of that name may be of another recording
            return chosen[name], 1.0 / unit_factor(chosen[name], si_unit)
    try:
        scale = 1.0 if unit == si_unit else 1.0 / unit_factor(unit, si_unit)
    except ValueError:  # of an unknown unit in the log of another program
        unit, scale = si_unit, 1.0
    return ("" if unit == "1" else unit), scale


def significant(value: float, digits: int) -> str:
    """A number with significant digits, such as '0.0123'; with an exponent only below 1e-4 and from 1e6 on."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def rounded_up(value: float) -> float:
    """The value rounded up to two digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit - 1e-9) * unit


def quantity_text(value: float, si_unit: str, digits: int = 4, name: str = "") -> str:
    """An SI value as text in the unit for display, such as '4.2 cm'; name: as for `display_unit`."""
    unit, scale = display_unit(si_unit, name)
    return f"{significant(scale * value, digits)} {unit}".rstrip()


NOT_METRIC_VOLUMES = ("gal", "ft^3", "in^3")


def small_length_text(value: float, digits: int = 3) -> str:
    """The width of a hole, m, as text: in mm if the unit of lengths for display is metric, else in that unit."""
    unit, scale = display_unit("m")
    decade = math.log10(scale)
    if abs(decade - round(decade)) < 1e-6:
        unit, scale = "mm", 1000.0
    return f"{scale * value:.{digits}g} {unit}"


def volume_unit() -> str:
    """The unit for display of a tank's volume: l, or that of the flows if it is not metric, as gal for gal/min."""
    chosen = _DISPLAYED.get().get("m^3")
    if chosen:
        return chosen
    flow = unit_factor(display_unit("m^3/s")[0], "m^3/s")
    of_flow = ((v, flow / unit_factor(f"{v}/{t}", "m^3/s")) for v in NOT_METRIC_VOLUMES for t in ("s", "min", "h"))
    return next((volume for volume, ratio in of_flow if abs(ratio - 1.0) < 1e-6), "l")


def displayed_words(name: str, otherwise: str) -> str:
    """The words for an effect at a place, 'back.pump_gain', in this context; `otherwise` if it has none of its own."""
    return _DISPLAYED.get().get(name, otherwise)


def displayed_units() -> Mapping[str, str]:
    """The units for display of this context."""
    return _DISPLAYED.get()


def display_in(units: Mapping[str, str]) -> None:
    """Set the units for display in this context: SI unit, or name of a channel or parameter -> unit; and the words for
    effects: place and name of an effect -> words.
    """
    _DISPLAYED.set(dict(units))


@contextmanager
def displayed_in(units: Mapping[str, str]) -> Iterator[None]:
    """Context within which quantities are displayed in these units, as `display_in` sets them."""
    token = _DISPLAYED.set(dict(units))
    try:
        yield
    finally:
        _DISPLAYED.reset(token)


def _in_chosen_unit(si_unit: str, chosen: Mapping[str, str]) -> str:
    if unit := chosen.get(si_unit) or _DEFAULT_UNITS.get(si_unit):
        return unit
    quantity, divided, by = si_unit.rpartition("/")
    if divided and (quantity in _DEFAULT_UNITS or by in _DEFAULT_UNITS):
        return f"{_in_chosen_unit(quantity, chosen)}/{_in_chosen_unit(by, chosen)}"
    return si_unit


_DEFAULT_UNITS = {"m": "cm", "m^2": "cm^2", "m^3": "cm^3", "m^3/s": "cm^3/s", "Pa": "mbar", "A": "mA"}
_DISPLAYED: ContextVar[Mapping[str, str]] = ContextVar("units for display", default=_DEFAULT_UNITS)
