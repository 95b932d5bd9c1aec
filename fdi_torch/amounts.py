"""Faults and estimates as text for people: terminal, page, log and Python say them in the same words."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from functools import partial

from fdi_torch.names import listed
from fdi_torch.parameters import ParameterName
from fdi_torch.quantities import display_unit, displayed_words, significant

RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def effect_words(effect: str, place: str) -> str:
    """'pump lag at Q1', from the effect's name in files, pump_lag; of a transfer, 'transfer lag at recycle'."""
    return f"{kind_words(effect, place)} at {place}"


def kind_words(effect: str, place: str) -> str:
    """An effect without its place: 'pump lag'."""
    return displayed_words(f"{place}.{effect}", effect.replace("_", " "))


def faults_in_words(names: Sequence[str]) -> list[str]:
    """Faults by the names of their parameters, each effect with all of its places: 'leak at T1 and T2'."""
    places: dict[str, list[str]] = {}
    for name in names:
        at = ParameterName.parse(name)
        places.setdefault(parameter_words(name).removesuffix(at.place), []).append(at.place)
    return [f"{words}{listed(at)}" for words, at in places.items()]


def parameter_words(name: str) -> str:
    """'T1.leak.size' -> 'leak at T1'; a constant, 'T1.area', -> 'area of T1'."""
    at = ParameterName.parse(name)
    if at.effect:
        return effect_words(at.effect, at.place)
    field = at.field.replace("_", " ")
    return f"{field} of {at.place}" if at.place else field


def sized_words(name: str, amounts: Sequence[str]) -> str:
    """'leak at T1 (size 0.3004 ± 0.0020, 30 cm^3/s)'."""
    return f"{parameter_words(name)} ({', '.join(amounts)})" if amounts else parameter_words(name)


def amount_words(name: str, text: str, unit: str) -> str:
    """'size 0.3' or '12 cm^3/s': the text of a parameter's value with its unit, or else with its name."""
    return f"{text} {unit}" if unit not in ("", "1") else f"{ParameterName.parse(name).field.replace('_', ' ')} {text}"


def estimate_words(name: str, si_unit: str, value: float, std: float = 0.0) -> str:
    """'size 0.3004 ± 0.0020' or '12.0 ± 1.2 cm^3/s', from SI values."""
    unit, scale = display_unit(si_unit, name)
    return amount_words(name, with_error(scale * value, scale * std), unit)


AT_95 = 1.96


def with_error(value: float, std: float, end: str = "") -> str:
    """'0.3000 ± 0.0020', '(2.44 ± 0.24)·10⁻⁷': the error with two digits, the value with as many decimals.

    A value with an infinite error is not determined. end: 'low' or 'high' for an estimate at an end of its range, which
    has a limit on one side only, 'below 0.051'.
    """
    if std == math.inf:
        return "not determined"
    if end and math.isfinite(value) and std > 0.0:
        return one_sided(value, std, end)
    if not (math.isfinite(value) and math.isfinite(std) and std > 0.0):
        return significant(value, 4) if math.isfinite(value) else "unknown"
    if (largest := max(abs(value), std)) < 1e-3:
        exponent = math.floor(math.log10(largest))
        return f"({with_error(value / 10.0**exponent, std / 10.0**exponent)})·10{str(exponent).translate(RAISED)}"
    if abs(value) >= 1e9:
        return f"{significant(value, 4)} ± {std:.2g}"
    digits = decimals(std)
    return f"{value:.{max(digits, 0)}f} ± {std:.{max(digits, 0)}f}"


def one_sided(value: float, std: float, end: str) -> str:
    """'below 0.051': the 95 % interval of an estimate at the 'low' or 'high' end of its range, where its probability is
    the half of a normal distribution that lies within the range.
    """
    reach = AT_95 * std
    return f"below {rounded(value + reach, std)}" if end == "low" else f"above {rounded(value - reach, std)}"


def interval_words(
    value: float,
    std: float,
    low: float = -math.inf,
    high: float = math.inf,
    end: str = "",
    show: Callable[[float], str] | None = None,
) -> str:
    """The 95 % interval as far as it lies within the range from low to high: '0.052 … 0.143'.

    It has a limit on one side, 'below 0.051', if the other one is the end of the range, whether or not the estimate
    lies there; where the readings set none, it is the range. end: as of `with_error`. show: the text of a limit; by
    default as many digits as the standard error has.
    """
    show = show or partial(rounded, std=std)
    if not (math.isfinite(value) and math.isfinite(std)):
        return "–"
    from_low, to_high = (value - AT_95 * std > low and end != "low"), (value + AT_95 * std < high and end != "high")
    if from_low and not to_high:
        return f"above {show(value - AT_95 * std)}"
    if to_high and not from_low:
        return f"below {show(value + AT_95 * std)}"
    limits = (value - AT_95 * std, value + AT_95 * std) if from_low else (low, high)
    return " … ".join(map(show, limits))


def end_words(name: str, end: str) -> str:
    """The sentence about an estimate at the 'low' or 'high' end of its range."""
    return f"{name} lies at the {end} end of its range" if end else f"{name} lies at an end of its range"


def probability_words(probability: float) -> str:
    """A probability with significant digits only: 'over 99.9 %', '97.2 %'."""
    if probability >= 0.9995:
        return "over 99.9 %"
    return f"{100.0 * probability:.1f} %" if probability >= 0.001 else "under 0.1 %"


def percent_text(mass: float) -> str:
    """The probability of an explanation of a monitor in whole percent: 'over 99 %', '60 %'."""
    return "over 99 %" if mass > 0.99 else f"{100.0 * mass:.0f} %" if mass >= 0.01 else "under 1 %"


def rounded(value: float, std: float) -> str:
    """The value with as many digits as show two of its standard error; with six where it has none, or one that is
    within the rounding of the numbers it was computed with.
    """
    if not (math.isfinite(value) and math.isfinite(std) and std > sys.float_info.epsilon * abs(value)):
        return f"{value:.6g}"
    digits = decimals(std)
    if digits <= 6:
        return f"{value:.{max(digits, 0)}f}"
    return f"{value:.{max(digits + math.floor(math.log10(abs(value) or std)), 1)}e}"


def decimals(std: float) -> int:
    """Decimals of a value with this standard error: as many as show two digits of the error; negative for tens."""
    return min(1 - math.floor(math.log10(std)), 12)
