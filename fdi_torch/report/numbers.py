"""Numbers and units as text for people, numbers out of a log's JSON, which may hold anything, and the rows of estimates
and correlations that `fdi train`, `fdi inspect` and pages show.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_torch import amounts
from fdi_torch.amounts import AT_95, LOWERED, RAISED
from fdi_torch.quantities import display_unit, significant

_RAISED_POWER = re.compile(rf"(?<=[^\W\d])[{''.join(map(chr, LOWERED))}]+")
_NEGATIVE = re.compile(r"(?<![\w.])-(?=\d)")


def shown_unit(si_unit: str, name: str = "") -> tuple[str, float]:
    """'m^3/s' -> ('cm³/s', 1e6): display unit and scale factor from SI; unknown units are unchanged. name: of a channel
    or sensor, which may have a unit of its own.
    """
    unit, scale = plain_unit(si_unit, name)
    return raised(unit), scale


def plain_unit(si_unit: str, name: str = "") -> tuple[str, float]:
    """As `shown_unit`, with the unit as on a terminal: ('cm^3/s', 1e6)."""
    try:
        return display_unit(si_unit, name)
    except ValueError:
        return si_unit, 1.0


def raised(unit: str) -> str:
    """'cm^3/s' -> 'cm³/s'."""
    head, *rest = unit.split("^")
    for part in rest:
        digits = len(part) - len(part.lstrip("0123456789-"))
        head += part[:digits].translate(RAISED) + part[digits:]
    return head


def lowered(text: str) -> str:
    """'33.1 cm³/s' -> '33.1 cm^3/s': words of a page as on a terminal."""
    return _RAISED_POWER.sub(lambda power: f"^{power[0].translate(LOWERED)}", text)


def sentence(message: str) -> str:
    """A message with units and minus signs as elsewhere on the page; '2026-11-24', 'hA-hB' and '1e-05' stay."""
    return _NEGATIVE.sub("−", raised(message))


def amount(value: float, si_unit: str, digits: int = 4, name: str = "") -> str:
    """An SI value in its display unit, such as '33.1 cm³/s'; name: as for `shown_unit`."""
    unit, scale = shown_unit(si_unit, name)
    return f"{number(scale * value, digits)} {unit}".rstrip()


def axis(name: str, unit: str) -> str:
    """'level, cm': label of an axis."""
    return f"{name}, {unit}" if unit else name


def number(value: float, digits: int = 4) -> str:
    """A number with the given significant digits, '2·10⁻⁵' where it needs an exponent; a dash for NaN."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    factor, _, exponent = significant(value, digits).partition("e")
    return _minus(factor) + (f"·10{str(int(exponent)).translate(RAISED)}" if exponent else "")


def with_error(value: float, std: float, end: str = "") -> str:
    """'0.3000 ± 0.0020': the error with two digits, the value with as many decimals; a dash for NaN. end: as for
    `amounts.with_error`.
    """
    return _minus(amounts.with_error(value, std, end)) if math.isfinite(value) else number(value)


def rounded_number(value: float, std: float) -> str:
    """'0.2985': a number with as many decimals as show two digits of its standard error."""
    return _minus(amounts.rounded(value, std)) if math.isfinite(value) else number(value)


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


HEADER = ("unit", "estimate", "95 % interval")


def estimate_cells(name: str, si_unit: str, value: float, std: float, end: str = "") -> list[str]:
    """The cells below HEADER of an SI value, in its unit for display; an infinite std: it is not determined. end: 'low'
    or 'high' for an estimate at an end of its range, see `amounts.with_error`.
    """
    unit, scale = shown_unit(si_unit, name)
    value, std = scale * value, scale * std
    if end and math.isfinite(std) and std > 0.0:
        return [unit or "1", rounded_number(value, std), with_error(value, std, end)]
    limits = (value - AT_95 * std, value + AT_95 * std)
    interval = " … ".join(rounded_number(limit, std) for limit in limits) if math.isfinite(std) else "–"
    return [unit or "1", with_error(value, std), interval]


def correlation_table(names: Sequence[str], covariance: np.ndarray) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the correlations (P, P) below the diagonal, of the parameters that are determined."""
    std = np.sqrt(np.diag(covariance))
    determined = np.flatnonzero(np.isfinite(std) & (std > 0.0)).tolist()
    rho = covariance[np.ix_(determined, determined)] / np.outer(std[determined], std[determined])
    numbers = [str(k + 1) for k in range(len(determined))]
    rows = [
        [f"{number}  {names[i]}", *(signed(rho[k, j]) if j <= k else "" for j in range(len(determined)))]
        for k, (number, i) in enumerate(zip(numbers, determined, strict=True))
    ]
    return ["correlation with", *numbers], rows


def signed(correlation: float) -> str:
    """A correlation with two decimals, never -0.00."""
    return f"{correlation:z.2f}".replace("-", "−")
