"""Units in text: 'cm^2', 'l/min/mA', 'cm3_s', 'm³·h⁻¹'. The only file that parses units and imports pint.

    unit     = factor { ('*' | '·' | '/' | ' ') factor }
    factor   = '1' | name [power] | '(' unit ')' [power]
    power    = ('^' | '**') integer | superscript digits,     |integer| <= 9
    quantity = number unit

Text outside this grammar, or longer than `MOST_CHARACTERS`, never reaches pint: it is not a unit.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from tokenize import TokenError
from typing import Any

import pint

MOST_CHARACTERS = 64

_registry: pint.UnitRegistry[float] = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
_registry.define("duty = [] ")
_registry.define("turn = 1 = _ = revolution = cycle = circle")  # counted as Hz counts: 60 rpm are 1 Hz, not 2 pi 1/s
_registry.define("lps = litre / second")
_registry.define("percent = 0.01 = pct")
for _short, _long in {"gpm": "gallon / minute", "gph": "gallon / hour", "lpm": "l / minute", "lph": "l / hour"}.items():
    _registry.define(f"{_short} = {_long}")

_HEADER_WORDS = {"pct": "%", "percent": "%", "lps": "l/s", "lpm": "l/min", "lph": "l/h", "gpm": "gal/min"}
_NAME = r"[A-Za-zµμΩΩ°][A-Za-zµμ0-9_]*+|[%‰]"
_POWER = r"\s*(?:(?:\^|\*\*)\s*[+-]?[0-9](?![\w.])|⁻?[¹²³⁴⁵⁶⁷⁸⁹])"
_FACTOR = rf"[\s(]*+(?:{_NAME}|1(?![\d.]))(?:{_POWER})?+(?:\s*\)(?:{_POWER})?+)*+\s*+"
_UNIT = re.compile(rf"{_FACTOR}(?:[*·/]?{_FACTOR})*+", re.UNICODE)
_FOR_PINT = str.maketrans({"·": "*", "%": " percent", "‰": " permille"})
_NUMBER = re.compile(r"\s*([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)(?![\d.])\s*(.*)", re.DOTALL | re.ASCII)
_VOLUME_A_TIME = re.compile(r"^((?:[cdm]?m|ft|in)3|m?[lL]|gal)_(s|min|h)$")  # headers of loggers without '/'
_CUBE = re.compile(r"(?<=[a-z])([23])(?![0-9])")


class UnitError(ValueError):
    """A text that is not a unit or not a quantity."""


def number_and_unit(text: str) -> tuple[float, str]:
    """'160 cm^2' -> (160.0, 'cm^2'); '5/s' -> (5.0, '1/s'); '0.3' -> (0.3, '1'). Raises UnitError."""
    match = _NUMBER.fullmatch(text) if len(text) <= MOST_CHARACTERS else None
    if match is None:
        raise UnitError(f"no quantity: {text[:MOST_CHARACTERS]}")
    number, unit = match[1], match[2].strip().removeprefix("*")
    if not math.isfinite(float(number)):
        raise UnitError(f"too large for a floating-point number: {number}")
    return float(number), f"1{unit}" if unit.startswith("/") else unit or "1"


def spelled(text: str) -> str:
    """A unit from a header as people write it: 'cm3_s' -> 'cm^3/s', 'pct' -> '%'."""
    return _CUBE.sub(r"^\1", _VOLUME_A_TIME.sub(r"\1/\2", _HEADER_WORDS.get(text, text)))


@lru_cache(maxsize=4096)
def factor(unit: str, target: str) -> float:
    """The value of one `unit` in `target`. Raises UnitError for an unknown unit or different dimensions."""
    return in_unit(1.0, unit, target)


@lru_cache(maxsize=4096)
def si_factor(unit: str) -> float:
    """The value of one `unit` in SI base units. Raises UnitError for an unknown unit."""
    return float(_registry.Quantity(1.0, _parsed(unit)).to_base_units().magnitude)


@lru_cache(maxsize=4096)
def same_kind(unit: str, among: tuple[str, ...]) -> str | None:
    """The first unit of `among` with the dimension of `unit`; None for another dimension or a text that is no unit."""
    try:
        dimension = _parsed(unit).dimensionality
        same = next((other for other in among if _parsed(other).dimensionality == dimension), None)
        if same is not None:
            factor(unit, same)  # of a finite size
    except UnitError:
        return None
    return same


def in_unit(number: float, unit: str, target: str) -> float:
    """A number in `unit` converted to `target`. Raises UnitError."""
    try:
        converted = float(_registry.Quantity(number, _parsed(unit)).to(_parsed(target)).magnitude)
    except (pint.PintError, OverflowError, ZeroDivisionError) as error:
        raise UnitError(str(error)) from None
    if math.isfinite(number) and not math.isfinite(converted):
        raise UnitError(f"too large for a floating-point number once converted: {number:g} {unit}")
    return converted


def is_unit(text: str) -> bool:
    """Whether a text is a unit, of whatever dimension."""
    try:
        _parsed(text)
    except UnitError:
        return False
    return True


@lru_cache(maxsize=4096)
def _parsed(text: str) -> Any:
    """The unit as an object of pint. Raises UnitError."""
    if len(text) > MOST_CHARACTERS:
        raise UnitError(f"too long for a unit: {text[:MOST_CHARACTERS]}...")
    text = _CUBE.sub(r"^\1", _VOLUME_A_TIME.sub(r"\1/\2", text.strip()))
    if not _UNIT.fullmatch(text) or text.count("(") != text.count(")"):
        raise UnitError(f"no unit: {text}")
    try:
        return _registry.parse_units(text.translate(_FOR_PINT), as_delta=False)
    except (pint.PintError, KeyError, ValueError, TypeError, SyntaxError, TokenError):
        raise UnitError(f"no unit: {text}") from None
