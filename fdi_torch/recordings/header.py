"""Units in the headers of columns."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from fdi_torch.quantities import si_unit_of
from fdi_torch.units import MOST_CHARACTERS


@lru_cache(maxsize=1024)
def header_unit(header: str) -> tuple[str, str] | None:
    """Split a CSV header of the form name_unit, name [unit] or name (unit): 'Q1_cm3_s' -> ('Q1', 'cm3_s'); None without
    a unit.

    The shortest name followed by a unit wins: `qL_cmd_lps` is (`qL_cmd`, `lps`), `Q1_cm3_s` is (`Q1`, `cm3_s`).
    `tank_A` is a name without unit: write amperes as mA, or in brackets.
    """
    cuts = [i for i in range(max(0, len(header) - MOST_CHARACTERS - 1), len(header)) if header[i] == "_"]
    splits = [(header[:i], header[i + 1 :]) for i in cuts if header[i + 1 :] != "A"]
    for name, unit in [bracketed] if (bracketed := _bracketed(header)) else splits:
        try:
            si_unit_of(unit)
        except ValueError:
            continue
        return name, unit
    return None


def names_in(header: Sequence[str]) -> set[str]:
    """What a channel may be called: whole headers, and names of headers with a unit."""
    return {*header, *(split[0] for column in header if (split := header_unit(column)))}


def _bracketed(header: str) -> tuple[str, str] | None:
    opening = {"]": "[", ")": "("}.get(header[-1:])
    place = header.rfind(opening) if opening else -1
    return (header[:place].rstrip(" \t_"), header[place + 1 : -1].strip()) if place > 0 else None
