"""Numbers and units as text for people, and numbers out of a log's JSON, which may hold anything."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fdi_torch.parameters import display_unit, significant

_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def shown_unit(si_unit: str, name: str = "") -> tuple[str, float]:
    """'m^3/s' -> ('cm³/s', 1e6): display unit and scale factor from SI; unknown units are unchanged. name: of a channel
    or sensor, which may have a unit of its own.
    """
    try:
        unit, scale = display_unit(si_unit, name)
    except ValueError:
        unit, scale = si_unit, 1.0
    return raised(unit), scale


def raised(unit: str) -> str:
    """'cm^3/s' -> 'cm³/s'."""
    head, *rest = unit.split("^")
    for part in rest:
        digits = len(part) - len(part.lstrip("0123456789-"))
        head += part[:digits].translate(_RAISED) + part[digits:]
    return head


def amount(value: float, si_unit: str, digits: int = 4, name: str = "") -> str:
    """An SI value in its display unit, such as '33.1 cm³/s'; name: as for `shown_unit`."""
    unit, scale = shown_unit(si_unit, name)
    return f"{number(scale * value, digits)} {unit}".rstrip()


def axis(name: str, unit: str) -> str:
    """'level, cm': label of an axis."""
    return f"{name}, {unit}" if unit else name


def number(value: float, digits: int = 4) -> str:
    """A number with the given significant digits; a dash for NaN."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    return _minus(significant(value, digits))


def with_error(value: float, std: float) -> str:
    """'0.3000 ± 0.0020', '(2.44 ± 0.24)·10⁻⁷': the error with two digits, the value with as many decimals.

    A value with an infinite error is not determined.
    """
    if std == math.inf:
        return "not determined"
    if not (math.isfinite(value) and math.isfinite(std) and std > 0.0):
        return number(value)
    if (largest := max(abs(value), std)) < 1e-3:
        exponent = math.floor(math.log10(largest))
        return f"({with_error(value / 10.0**exponent, std / 10.0**exponent)})·10{str(exponent).translate(_RAISED)}"
    digits = min(max(1 - math.floor(math.log10(std)), 0), 12)
    return _minus(f"{value:.{digits}f} ± {std:.{digits}f}") if abs(value) < 1e9 else f"{number(value)} ± {std:.2g}"


def percent(share: float) -> str:
    return f"{100.0 * share:.3g} %" if math.isfinite(share) else "–"


def probability_text(probability: float) -> str:
    """A probability in percent; one below 0.1 % is not resolved further."""
    return "< 0.1 %" if probability < 1e-3 else percent(probability)


def _minus(text: str) -> str:
    return text.replace("-", "−")


def as_float(value: Any) -> float:
    """A number of a log; NaN for anything else."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def as_vector(values: Any) -> np.ndarray:
    return np.array([as_float(value) for value in values])
