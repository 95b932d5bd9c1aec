"""Sheets: channels that were logged together, and the merging of several sheets with different times.

A plant's historian may log levels every second, flows every ten seconds and a valve when it moves: in one file with
empty cells, in one file each, or with one row per value. A missing value is NaN, a value that was logged as bad is BAD.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdi_torch.names import counted
from fdi_torch.recording import Hold

LONG_AGO = 1e8  # s; larger times are seconds since 1970
HOUR, NEARLY = 3600.0, 120.0  # s
LATE_SHARE, LOST_SHARE = 0.1, 0.5
"""A column is no clock if more than these shares of its rows come late, and have the time of another but other values:
rows in any order of one clock have times of their own, and times that were rounded rarely decrease.
"""
HELD_MARGIN = 1e-3
"""Tolerance on the time for which a value is held, for sampling intervals that vary slightly."""


@dataclass(frozen=True)
class Sheet:
    """seconds (R,): increasing, on a clock common to all sheets; values (R, C): of the named channels, SI."""

    source: str
    seconds: np.ndarray
    names: tuple[str, ...]
    values: np.ndarray


def in_order(
    seconds: np.ndarray, values: np.ndarray, sort: bool, place: str, rows: np.ndarray, summer: str
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """The rows in order of time, one per instant, and notes on changes.

    Rows that repeat the one before are dropped; with `sort`, the others are sorted and rows with equal times merged.
    Of several values of a channel at one time the last one counts. place: format of a row in messages; rows: their
    numbers. summer: advice for a clock that was set back by an hour. Raises ValueError if time does not increase, and
    with `sort` if most rows would be lost because the column is no clock.
    """
    notes = []
    repeated = (np.diff(seconds) == 0.0) & _equal(values[1:], values[:-1]).all(axis=1)
    if repeated.any():
        notes.append(f"{counted(int(repeated.sum()), 'row')} repeating the one before left out")
    kept = np.append(True, ~repeated)
    rows, seconds, values = rows[kept], seconds[kept], values[kept]
    decreasing = np.flatnonzero(np.diff(seconds) <= 0)
    if not len(decreasing):
        return seconds, values, notes
    out_of_order = int((np.diff(seconds) < 0).sum())
    times, merged, lost = _merged(seconds, values)
    if out_of_order > LATE_SHARE * len(seconds) and lost > LOST_SHARE * len(seconds):
        drop = int(np.argmax(np.diff(seconds) < 0))
        raise ValueError(
            f"{place.format(rows[drop + 1])}: expected time, got a column in which {out_of_order} of {len(seconds)} "
            f"rows come late and {lost} have the time of another row: it is no clock; name the column of time: "
            "columns: {t: {column: ..., unit: s}}, or give the time between rows: columns: {t: {period: 50 ms}}"
        )
    if not sort:
        drop = int(decreasing[0])
        before, after = seconds[drop : drop + 2] - (seconds[0] if abs(seconds[0]) > LONG_AGO else 0.0)
        fix = "correct the clock, or let rows be sorted: columns: {t: {sort: true}}"
        if (np.diff(seconds) >= 0).all():
            fix = "keep the last row of each time by columns: {t: {sort: true}}, or count rows: {t: {period: 50 ms}}"
        fix = summer if summer and abs(before - after - HOUR) < NEARLY else fix
        if seconds[0] < -LONG_AGO:  # a format without a date means the year 1900
            fix = "a clock without dates begins anew at midnight; add the date to its column"
        raise ValueError(
            f"{place.format(rows[drop + 1])}: expected time that increases, got {after:g} s after {before:g} s "
            f"({counted(len(decreasing), 'such row')}); {fix}"
        )
    notes.append(f"rows sorted by time: {out_of_order} came late, {len(seconds) - len(times)} had the time of another")
    return times, merged, notes


def _equal(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a == b) | (np.isnan(a) & np.isnan(b))


def _merged(seconds: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """One row per time, in order, with the last logged value of each channel; and how many rows have another value."""
    order = np.argsort(seconds, kind="stable")
    times, place = np.unique(seconds, return_inverse=True)
    merged = np.full((len(times), values.shape[1]), np.nan)
    for k in range(values.shape[1]):
        logged = order[~np.isnan(values[order, k])]
        merged[place[logged], k] = values[logged, k]  # numpy keeps the last of several values for one index
    lost = int((~np.isnan(values) & (values != merged[place])).any(axis=1).sum())
    return times, merged, lost


def merge_sheets(sheets: Sequence[Sheet], hold_times: Mapping[str, float], hold: Hold) -> Sheet:
    """All sheets as one, on the union of their times.

    hold_times: for each input, how long its last value is held after empty cells, s. Inputs continue between the rows
    of their own sheet; a reading is present only where it was logged. Raises ValueError if a sheet's times do not
    overlap with the others', for example because it counts from its own start.
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
            if name in hold_times:
                columns.append(_resampled_input(times, clock, column, hold_times[name], hold))
                continue
            placed = np.full(len(times), np.nan)
            placed[rows] = np.where(np.isfinite(column), column, np.nan)
            columns.append(placed)
    values = np.stack(columns, axis=1) if columns else np.empty((len(times), 0))
    names = tuple(name for sheet in sheets for name in sheet.names)
    return Sheet(sheets[0].source, times + (origin if len(sheets) > 1 else 0.0), names, values)


def _resampled_input(
    times: np.ndarray, clock: np.ndarray, column: np.ndarray, hold_time: float, hold: Hold
) -> np.ndarray:
    """An input at all times (T,) from its own rows (R,); NaN before the first, and after it is no longer held."""
    filled = fill_held(clock, column, hold_time, hold)
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
    stale = times - (clock[logged[-1]] if len(logged) else np.inf) > hold_time * (1.0 + HELD_MARGIN)
    return np.where((row < 0) | ((times > clock[-1]) & stale), np.nan, value)


def _expect_common_time(sheets: Sequence[Sheet]) -> None:
    """Raises ValueError if a sheet begins after all others have ended. A channel logged on change may end early."""
    late = max(sheets, key=lambda s: float(s.seconds[0]))
    last = max((s for s in sheets if s is not late), key=lambda s: float(s.seconds[-1]))
    if late.seconds[0] > last.seconds[-1]:
        raise ValueError(
            f"{late.source}: expected time in common with {last.source}, got {late.seconds[0]:.15g} s as its first and "
            f"{last.seconds[-1]:.15g} s as the other's last; say how late its clock is: columns: {{t: {{shift: 37 s}}}}"
        )


def informative_rows(inputs: np.ndarray, outputs: np.ndarray, hold: Hold) -> np.ndarray:
    """The rows (R,) from the first to the last reading that have a reading or a new input value.

    Under a linear hold, every row is a corner of an input and is kept.
    """
    read = ~np.isnan(outputs).all(axis=1)
    informative = np.append(True, ~_equal(inputs[1:], inputs[:-1]).all(axis=1)) | read | (hold == "linear")
    number = np.arange(len(read))
    return informative & np.logical_or.accumulate(read) & (number <= (number[read][-1] if read.any() else -1))


def without_missing_rows(seconds: np.ndarray, inputs: np.ndarray, hold_times: Sequence[float]) -> np.ndarray:
    """Inputs (R, M), NaN in rows whose next row is later than the hold time of the input, s (0: unlimited)."""
    wait = np.diff(seconds, append=seconds[-1:])
    most = np.array([time * (1.0 + HELD_MARGIN) if time > 0.0 else np.inf for time in hold_times])
    return np.where(wait[:, None] > most, np.nan, inputs)


def fill_held(seconds: np.ndarray, column: np.ndarray, hold_time: float, hold: Hold) -> np.ndarray:
    """An input (R,) with empty cells filled by the last value, for at most `hold_time` s.

    Under a linear hold they are interpolated, if the next value is no further away. A bad value is NaN and ends the
    hold.
    """
    filled = _filled(seconds, column, hold_time * (1.0 + HELD_MARGIN), hold) if hold_time > 0.0 else column
    return np.where(np.isfinite(filled), filled, np.nan)


def _filled(seconds: np.ndarray, column: np.ndarray, hold_time: float, hold: Hold) -> np.ndarray:
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
        valid = np.isfinite(column[last]) & np.isfinite(column[after]) & (span <= hold_time) & known
        ends = [np.where(valid, column[place], 0.0) for place in (last, after)]
        return np.where(logged, column, np.where(valid, ends[0] + share * (ends[1] - ends[0]), np.nan))
    return np.where(known & (seconds - seconds[last] <= hold_time), column[last], np.nan)
