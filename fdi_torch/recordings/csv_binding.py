"""Channels tied to the columns of a CSV file: by a header that tells its unit, or by what was said of them."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan
from pathlib import Path

from fdi_torch.parameters import header_unit, si_unit_of, unit_factor
from fdi_torch.recordings.csv_cells import BAD, GOOD_WORDS, Columns, Rule
from fdi_torch.recordings.csv_text import Heading
from fdi_torch.recordings.source import ChannelSource, ClockSource
from fdi_torch.recordings.stamps import stamp_reader

TIME_NAMES = (
    *("t", "time", "timestamp", "datetime", "date time", "date_time", "date/time", "time stamp", "utc"),
    *("epoch", "unixtime", "zeit", "zeitstempel", "datum", "date"),
)


@dataclass(frozen=True)
class Bound:
    """A channel tied to the file: position of its column (or a constant), factor into SI, SI unit, and what its cells
    mean. stamps: its cells are time stamps. plus: what is added to it.
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


def bind_clock(path: Path, header: Sequence[str], source: ChannelSource | None) -> Bound:
    """The column of time: the one mapped, or one of `TIME_NAMES` with a unit, or one of them that holds time stamps."""
    source = source or ClockSource()
    if source.column is None:
        split = {h: header_unit(h) for h in header}
        timed = [h for h, found in split.items() if found and found[0].lower() in TIME_NAMES]
        stamped = sorted((h for h in header if h.lower() in TIME_NAMES), key=lambda h: TIME_NAMES.index(h.lower()))
        source = replace(source, column=(timed or stamped or ["t"])[0])
    column = _find_column(path, header, "t", source.column)
    if source.unit is None and header_unit(column) is None:
        return Bound("t", column, header.index(column), 1.0, "s", stamps=True)
    return bind(path, header, "t", source, "s")


def bind(path: Path, header: Sequence[str], name: str, source: ChannelSource | None, want: str | None = None) -> Bound:
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
        raise ValueError(f"{path}: column {column}: {error}") from error
    rule = _rule(path, header, name, source)
    plus = tuple(bind(path, header, name, replace(source, column=each, plus=()), si_unit) for each in source.plus)
    return Bound(name, column, header.index(column), factor, si_unit, rule=rule, plus=plus)


def column_of(path: Path, header: Sequence[str], column: str) -> str:
    """A header that was given for what is no channel. Raises ValueError where there is none."""
    if column in header:
        return column
    near = difflib.get_close_matches(column, header, n=1, cutoff=0.5)
    hint = f"; the nearest is {near[0]}" if near else ""
    raise ValueError(f"{path}: expected a column '{column}', got {', '.join(header)}{hint}")


def _rule(path: Path, header: Sequence[str], name: str, source: ChannelSource) -> Rule | None:
    if not source.words and source.quality is None:
        return None
    quality = None if source.quality is None else header.index(column_of(path, header, source.quality))
    return rule_of(source, quality)


def rule_of(source: ChannelSource, quality: int | None) -> Rule:
    """What was said of a channel's cells. Words that are numbers, such as -9999, are known by their value."""
    words = {text.strip().lower(): BAD if isnan(value) else value for text, value in source.words.items()}
    good = frozenset(word.strip().lower() for word in source.good) or GOOD_WORDS
    return Rule(words, quality, good)


def _find_column(path: Path, header: Sequence[str], name: str, column: str | None) -> str:
    """The column mapped to a channel: by its whole header, or by the name in a header of the form name_unit."""
    wanted = column or name
    splits = [(h, header_unit(h)) for h in header]
    meant = [h for h in header if h == wanted] or [h for h, split in splits if split and split[0] == wanted]
    if len(meant) > 1:
        fix = f"map one under columns: {{{name}: {{column: {meant[0]}}}}}" if meant[0] != meant[1] else "rename one"
        raise ValueError(f"{path}: expected one column for {name}, got {' and '.join(meant)}; {fix}")
    if meant:
        return meant[0]
    names = {split[0]: h for h, split in splits if split}
    near = difflib.get_close_matches(wanted, [*header, *names], n=1, cutoff=0.5)
    near = [h for h in header if h.lower().startswith(wanted.lower())] or near if len(wanted) > 1 else near
    hint = f"; the nearest is {names.get(near[0], near[0])}" if near else ""
    raise ValueError(
        f"{path}: expected a column for {name} ('{wanted}' or '{wanted}_UNIT'), got {', '.join(header)}{hint}; "
        f"map it under columns: {{{name}: {{column: ..., unit: ...}}}}"
    )


def _unit_in(path: Path, column: str, name: str) -> str:
    split = header_unit(column)
    if split is None:
        raise ValueError(
            f"{path}: column {column}: expected a header of the form name_unit such as h1_cm, got no unit in it; "
            f"give the unit under columns: {{{name}: {{column: {column}, unit: ...}}}}"
        )
    return split[1]


def columns_of(
    path: Path, heading: Heading, bounds: Sequence[Bound], clock: ChannelSource | None = None, sparse: bool = False
) -> Columns:
    """The columns of the file that are read, each once, in the order of their first use: time comes first.

    clock: how its time stamps are written. sparse: empty cells are other than those that say that nothing was read.
    """
    bounds = [each for bound in bounds for each in (bound, *bound.plus)]
    positions = list(dict.fromkeys(b.position for b in bounds if b.position is not None))
    rules = {b.position: b.rule for b in bounds if b.position is not None and b.rule is not None}
    stamps = next((b.position for b in bounds if b.stamps), None)
    read = stamp_reader(clock.stamps, clock.zone) if isinstance(clock, ClockSource) else stamp_reader(None, None)
    return Columns(path, heading, positions, stamps, read, rules, sparse)
