"""Channels that were logged together, and how several such sheets, each with times of its own, become one recording.

A plant's historian writes levels every second, flows every ten and a valve when it moves: in one file with empty cells,
in a file each, or with a row for each value. What was not logged at an instant is NaN, what was logged as bad is BAD.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdi_torch.recording import Hold

LONG_AGO = 1e8  # s; a clock that is beyond counts from 1970
HOUR, NEARLY = 3600.0, 120.0  # s
HELD_MARGIN = 1e-3
"""A sampling interval that wavers by so little is still the one for which a value stands."""


@dataclass(frozen=True)
class Sheet:
    """seconds (R,) increasing, on a clock that all sheets share; values (R, C) in SI of the named channels."""

    source: str
    seconds: np.ndarray
    names: tuple[str, ...]
    values: np.ndarray


@dataclass(frozen=True)
class Ordered:
    """Rows in the order of time, one an instant; told: what was done for it."""

    seconds: np.ndarray
    values: np.ndarray
    told: list[str]


def in_order(
    seconds: np.ndarray,
    values: np.ndarray,
    sort: bool,
    place: str,
    first: int,
    summer: str = "",
    rows: np.ndarray | None = None,
) -> Ordered:
    """Rows that repeat the one before are dropped; others are sorted where `sort` says so, the last value of each
    channel counting where several have one time.

    place: of a row in error messages, whose number is counted from `first` or stands in `rows`. summer: what to do
    where the clock is put back by an hour. Raises ValueError
    where time does not increase.
    """
    told = []
    same = (np.diff(seconds) == 0.0) & _equal(values[1:], values[:-1]).all(axis=1)
    if same.any():
        told.append(f"{_rows(same.sum())} repeating the one before left out")
    numbers = (first + np.arange(len(seconds)) if rows is None else rows)[np.append(True, ~same)]
    seconds, values = seconds[np.append(True, ~same)], values[np.append(True, ~same)]
    back = np.flatnonzero(np.diff(seconds) <= 0)
    if not len(back):
        return Ordered(seconds, values, told)
    if not sort:
        before, after = seconds[back[0] : back[0] + 2] - (seconds[0] if seconds[0] > LONG_AGO else 0.0)
        fix = "correct the clock, or let rows be sorted: columns: {t: {sort: true}}"
        fix = summer if summer and abs(before - after - HOUR) < NEARLY else fix
        raise ValueError(
            f"{place.format(numbers[back[0] + 1])}: expected time that increases, got {after:g} s after {before:g} s "
            f"({_rows(len(back), 'such ')}); {fix}"
        )
    late = int((np.diff(seconds) < 0).sum())
    times, merged = _merged(seconds, values)
    told.append(f"rows sorted by time: {late} came late, {len(seconds) - len(times)} had the time of another")
    return Ordered(times, merged, told)


def _rows(count: int, such: str = "") -> str:
    return f"one {such}row" if count == 1 else f"{count} {such}rows"


def _equal(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a == b) | (np.isnan(a) & np.isnan(b))


def _merged(seconds: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One row for each time, in order, with the last value of each channel that was logged for it."""
    order = np.argsort(seconds, kind="stable")
    times, place = np.unique(seconds, return_inverse=True)
    merged = np.full((len(times), values.shape[1]), np.nan)
    for k in range(values.shape[1]):
        logged = order[~np.isnan(values[order, k])]
        merged[place[logged], k] = values[logged, k]  # of several at one place numpy keeps the last
    return times, merged


def woven(sheets: Sequence[Sheet], stands: Mapping[str, float], hold: Hold) -> Sheet:
    """All sheets as one, on the union of their times. Inputs (`stands`: for how long a value stands where cells after
    it are empty, s) run on between the rows of their own sheet; a reading is there only where it was logged.

    Raises ValueError where a sheet has no time in common with the others, as where it counts from its own start.
    """
    if len(sheets) > 1:
        _expect_common_time(sheets)
    origin = min(float(s.seconds[0]) for s in sheets)
    clocks = [s.seconds if len(sheets) == 1 else np.round(s.seconds - origin, 6) for s in sheets]
    times = np.unique(np.concatenate(clocks)) if len(sheets) > 1 else clocks[0]
    columns: list[np.ndarray] = []
    for sheet, clock in zip(sheets, clocks, strict=True):
        rows = np.searchsorted(times, clock)
        for name, column in zip(sheet.names, sheet.values.T, strict=True):
            if name in stands:
                columns.append(_running(times, clock, column, stands[name], hold))
                continue
            placed = np.full(len(times), np.nan)
            placed[rows] = np.where(np.isfinite(column), column, np.nan)
            columns.append(placed)
    values = np.stack(columns, axis=1) if columns else np.empty((len(times), 0))
    return Sheet(sheets[0].source, times + (origin if len(sheets) > 1 else 0.0), _names(sheets), values)


def _names(sheets: Sequence[Sheet]) -> tuple[str, ...]:
    return tuple(name for sheet in sheets for name in sheet.names)


def _running(times: np.ndarray, clock: np.ndarray, column: np.ndarray, most: float, hold: Hold) -> np.ndarray:
    """An input at all times (T,) by its own rows (R,); unknown before the first, and once it stands no longer."""
    filled = held(clock, column, most, hold)
    if times is clock:
        return filled
    row = np.searchsorted(clock, times, side="right") - 1
    here, after = np.maximum(row, 0), np.minimum(row + 1, len(clock) - 1)
    value = filled[here]
    if hold == "linear":
        share = np.where(
            after > here, (times - clock[here]) / np.where(after > here, clock[after] - clock[here], 1.0), 0
        )
        value = np.where(share > 0.0, value + share * (filled[after] - value), value)
    logged = np.flatnonzero(~np.isnan(column))
    stale = times - (clock[logged[-1]] if len(logged) else np.inf) > most * (1.0 + HELD_MARGIN)
    return np.where((row < 0) | ((times > clock[-1]) & stale), np.nan, value)


def _expect_common_time(sheets: Sequence[Sheet]) -> None:
    """What is logged on change may have ended long before the rest; nothing may begin after all else has ended."""
    late = max(sheets, key=lambda s: float(s.seconds[0]))
    last = max((s for s in sheets if s is not late), key=lambda s: float(s.seconds[-1]))
    if late.seconds[0] > last.seconds[-1]:
        raise ValueError(
            f"{late.source}: expected time in common with {last.source}, got {late.seconds[0]:.15g} s as its first and "
            f"{last.seconds[-1]:.15g} s as the other's last; say how late its clock is: columns: {{t: {{shift: 37 s}}}}"
        )


def telling_rows(inputs: np.ndarray, outputs: np.ndarray, hold: Hold) -> np.ndarray:
    """Rows (R,), from the first reading to the last, that hold a reading or in which an input becomes another one;
    under a linear hold each is a corner of an input.
    """
    read = ~np.isnan(outputs).all(axis=1)
    tells = np.append(True, ~_equal(inputs[1:], inputs[:-1]).all(axis=1)) | read | (hold == "linear")
    number = np.arange(len(read))
    return tells & np.logical_or.accumulate(read) & (number <= (number[read][-1] if read.any() else -1))


def held(seconds: np.ndarray, column: np.ndarray, most: float, hold: Hold) -> np.ndarray:
    """An input (R,) where nothing was logged: the last value for as long as it stands (`most`, s), or under a linear
    hold the line to the next one, where that is no further off. A bad value ends what it follows, and is NaN.
    """
    filled = _filled(seconds, column, most * (1.0 + HELD_MARGIN), hold) if most > 0.0 else column
    return np.where(np.isfinite(filled), filled, np.nan)


def _filled(seconds: np.ndarray, column: np.ndarray, most: float, hold: Hold) -> np.ndarray:
    logged = ~np.isnan(column)
    if not logged.any():
        return column
    number = np.arange(len(column))
    last = np.maximum.accumulate(np.where(logged, number, -1))
    known, last = last >= 0, np.maximum(last, 0)
    if hold == "linear":
        after = np.minimum.accumulate(np.where(logged, number, len(column))[::-1])[::-1]
        known, after = known & (after < len(column)), np.minimum(after, len(column) - 1)
        span = seconds[after] - seconds[last]
        share = np.where(span > 0, (seconds - seconds[last]) / np.where(span > 0, span, 1.0), 0.0)
        sound = np.isfinite(column[last]) & np.isfinite(column[after]) & (span <= most) & known
        ends = [np.where(sound, column[place], 0.0) for place in (last, after)]
        return np.where(logged, column, np.where(sound, ends[0] + share * (ends[1] - ends[0]), np.nan))
    return np.where(known & (seconds - seconds[last] <= most), column[last], np.nan)
