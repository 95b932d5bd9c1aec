"""The binding of channels to the columns of a CSV file, by headers with units or by the mapping in the
configuration.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan
from pathlib import Path

from fdi_torch.names import nearest, shortened, similar
from fdi_torch.quantities import si_unit_of, unit_factor
from fdi_torch.recordings.csv_cells import BAD, GOOD_WORDS, Columns, Rule
from fdi_torch.recordings.csv_text import Heading, header_unit
from fdi_torch.recordings.source import ChannelSource, ClockSource, clock_in
from fdi_torch.recordings.time_stamps import StampReader
from fdi_torch.units import spelled

TIME_WORDS = (
    *("t", "time", "timestamp", "datetime", "stamp", "utc", "epoch", "unixtime"),
    *("zeit", "zeitstempel", "uhrzeit", "local", "datum", "date"),
)
"""A column whose name consists of these words is one of time; the first of these words decides between several."""


@dataclass(frozen=True)
class Bound:
    """A channel bound to a column: position (None for a constant), factor into SI, SI unit, and the rule of its cells.

    stamps: whether its cells are time stamps. plus: further columns that are added to it. unit: as written.
    """

    name: str
    header: str
    position: int | None
    factor: float
    si_unit: str
    constant: float = float("nan")
    stamps: bool = False
    rule: Rule | None = None
    plus: tuple[Bound, ...] = ()
    unit: str = ""


def bind_clock(path: Path, header: Sequence[str], source: ClockSource) -> Bound:
    """The column that holds the time of each row.

    In order of preference: the column that the configuration names; a column whose header means time and has a unit,
    such as 't_s'; a column whose header means time and has none, which must hold time stamps. If the configuration
    gives a period instead, no column is read, and row k (from 0) has the time k times the period.
    """
    if source.period is not None:
        return Bound("t", "t", None, source.period, "s")
    if source.column is None:
        units = {h: header_unit(h) for h in header}
        timed = [h for h, unit in units.items() if unit and _means_time(unit[0])]
        stamped = sorted((h for h in header if _means_time(h)), key=lambda h: min(map(TIME_WORDS.index, _words(h))))
        source = replace(source, column=(timed or stamped or ["t"])[0])
    column = _find_column(path, header, "t", source.column)
    if source.unit is None and header_unit(column) is None:
        return Bound("t", column, header.index(column), 1.0, "s", stamps=True)
    return bind(path, header, "t", source, "s")


def _means_time(name: str) -> bool:
    return bool(_words(name)) and set(TIME_WORDS).issuperset(_words(name))


def _words(name: str) -> list[str]:
    return re.findall(r"[^\W_]+", name.lower())


def bind(path: Path, header: Sequence[str], name: str, source: ChannelSource | None, want: str | None = None) -> Bound:
    """The binding of one channel; want: its SI unit. Raises ValueError for a missing column or a wrong unit."""
    source = source or ChannelSource()
    if source.constant is not None:
        unit = source.unit or "1"
        return Bound(name, name, None, 1.0, unit, source.constant)
    column = _find_column(path, header, name, source.column)
    unit = source.unit or _unit_in(path, column, name)
    try:
        si_unit = want or si_unit_of(unit)
        factor = unit_factor(unit, si_unit)
    except ValueError as error:
        raise ValueError(f"{path}: column {column}: {error}") from None
    rule = _rule(path, header, name, source)
    plus = tuple(bind(path, header, name, replace(source, column=each, plus=()), si_unit) for each in source.plus)
    return Bound(name, column, header.index(column), factor, si_unit, rule=rule, plus=plus, unit=unit)


def unit_notes(bounds: Sequence[Bound]) -> list[str]:
    """A note on each channel whose mapping states another unit of the same kind than its header."""
    notes = []
    for bound in bounds:
        _, in_header = (bound.position is not None and header_unit(bound.header)) or ("", bound.unit)
        if spelled(in_header) != spelled(bound.unit) and si_unit_of(in_header) == bound.si_unit:
            notes.append(f"{bound.header}: read in {bound.unit} as mapped, although its header says {in_header}")
    return notes


def column_of(path: Path, header: Sequence[str], column: str) -> str:
    """The header `column`, checked to exist. Raises ValueError, which suggests the most similar header."""
    if column in header:
        return column
    raise ValueError(f"{path}: expected a column '{column}', got {', '.join(header)}{nearest(column, header)}")


def _rule(path: Path, header: Sequence[str], name: str, source: ChannelSource) -> Rule | None:
    if not source.words and source.quality is None:
        return None
    quality = None if source.quality is None else header.index(column_of(path, header, source.quality))
    return rule_of(source, quality)


def rule_of(source: ChannelSource, quality: int | None) -> Rule:
    """The rule of a channel's cells. Words that are numbers, such as -9999, are compared by value."""
    words = {text.strip().lower(): BAD if isnan(value) else value for text, value in source.words.items()}
    good = frozenset(word.strip().lower() for word in source.good) or GOOD_WORDS
    return Rule(words, quality, good)


def _find_column(path: Path, header: Sequence[str], name: str, column: str | None) -> str:
    """The column of a channel: with this whole header, or with this name in a header of the form name_unit."""
    requested = column or name
    names_and_units = [(h, header_unit(h)) for h in header]
    matches = [h for h in header if h == requested] or [
        h for h, pair in names_and_units if pair and pair[0] == requested
    ]
    if len(matches) > 1:
        fix = (
            f"map one under columns: {{{name}: {{column: {matches[0]}}}}}" if matches[0] != matches[1] else "rename one"
        )
        raise ValueError(f"{path}: expected one column for {name}, got {' and '.join(matches)}; {fix}")
    if matches:
        return matches[0]
    names = {pair[0]: h for h, pair in names_and_units if pair}
    near = similar(requested, [*header, *names])
    hint = f"; the nearest is '{shortened(names.get(near[0], near[0]))}'" if near else ""
    without = ", or give the time between its rows: columns: {t: {period: 50 ms}}" if name == "t" else ""
    raise ValueError(
        f"{path}: expected a column for {name} ('{requested}' or '{requested}_UNIT'), got "
        f"{', '.join(map(shortened, header))}{hint}; "
        f"map it under columns: {{{name}: {{column: ..., unit: ...}}}}{without}"
    )


def _unit_in(path: Path, column: str, name: str) -> str:
    name_and_unit = header_unit(column)
    if name_and_unit is None:
        raise ValueError(
            f"{path}: column {column}: expected a header of the form name_unit such as h1_cm, got no unit in it; "
            f"give the unit under columns: {{{name}: {{column: {column}, unit: ...}}}}"
        )
    return name_and_unit[1]


def bind_table(
    path: Path, heading: Heading, names: Sequence[str], sources: Mapping[str, ChannelSource]
) -> tuple[Bound, list[Bound], Columns]:
    """The clock, the channels, and the columns to read: each once, in the order of first use, time first."""
    source = clock_in(sources)
    clock = bind_clock(path, heading.names, source)
    channels = [bind(path, heading.names, name, sources.get(name)) for name in names]
    sparse = any(sources[name].held > 0.0 for name in names if name in sources)
    bounds = [clock, *(each for bound in channels for each in (bound, *bound.plus))]
    positions = list(dict.fromkeys(b.position for b in bounds if b.position is not None))
    rules = {b.position: b.rule for b in bounds if b.position is not None and b.rule is not None}
    stamps = clock.position if clock.stamps else None
    columns = Columns(path, heading, positions, stamps, StampReader(source.stamps, source.zone), rules, sparse)
    return clock, channels, columns
