"""Time stamps of loggers, converted to seconds since 1970: ISO 8601, day.month.year, or a given format."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

QUARTER = 900.0
"""Offsets of time zones are multiples of a quarter of an hour, s."""
BACK = 1000.0
"""A clock that goes back by more than this was set back, s."""
_DOTTED = re.compile(r"^(\d{1,2})\.(\d{1,2})\.(\d{4})[ T](\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,6}))?)?$", re.ASCII)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class StampReader:
    """A function from a stamp's text to seconds since 1970, NaN for an empty cell. A stamp without offset is UTC.

    It raises ValueError for a stamp in another format, and for one with an offset if a zone is given. offset: of the
    last stamp, s.
    """

    def __init__(self, form: str | None = None, zone: str | None = None) -> None:
        self._form, self._zone, self.offset = form, zone, 0.0

    def __call__(self, text: str) -> float:
        stamp = text.strip().strip('"')
        if not stamp:
            return float("nan")
        moment = _with_format(stamp, self._form) if self._form else _plain(stamp)
        offset = moment.utcoffset()
        if offset is None:
            return (moment.replace(tzinfo=UTC) - _EPOCH).total_seconds()
        if self._zone:
            raise ValueError(f"expected local time of {self._zone}, got '{stamp}' with its offset; leave the zone out")
        self.offset = offset.total_seconds()
        return moment.timestamp()


seconds_of = StampReader()
"""Seconds since 1970 of an ISO 8601 time stamp, or of one such as 29.3.2026 08:30:00."""


def _plain(stamp: str) -> datetime:
    try:
        return datetime.fromisoformat(stamp)
    except ValueError:
        pass
    if match := _DOTTED.match(stamp):
        day, month, year, hour, minute, second, fraction = (part or "0" for part in match.groups())
        moment = (int(part) for part in (year, month, day, hour, minute, second))
        return datetime(*moment) + timedelta(microseconds=int(fraction.ljust(6, "0")))  # type: ignore[arg-type]
    if stamp.replace(".", "", 1).isdigit():
        raise ValueError(f"expected a time stamp, got the number {stamp}; give its unit, as in t: {{unit: ms}}")
    raise ValueError(
        f"expected a time stamp such as 2026-03-29T08:30:00 or 2026-03-29 08:30:00.25+01:00, got '{stamp}'; "
        "say how it is written, as in t: {stamps: '%d/%m/%Y %H:%M:%S'}"
    )


def _with_format(stamp: str, form: str) -> datetime:
    try:
        return datetime.strptime(stamp, form)
    except ValueError as error:
        raise ValueError(f"expected a time stamp like '{form}', got '{stamp}' ({error})") from None


def expect_zone(zone: str) -> None:
    """Raises ValueError for an unknown time zone."""
    try:
        ZoneInfo(zone)
    except (ZoneInfoNotFoundError, ValueError):
        raise ValueError(f"expected a time zone by its IANA name such as Europe/Berlin, got '{zone}'") from None


def from_zone(local: np.ndarray, zone: str) -> np.ndarray:
    """Seconds since 1970 of local times (R,), which are given as seconds since 1970 as if they were UTC.

    In an hour that occurs twice, times count as the first occurrence until the clock goes back, then as the second.
    """
    quarters, place = np.unique(np.floor(local / QUARTER), return_inverse=True)
    naive = [_EPOCH.replace(tzinfo=None) + timedelta(seconds=float(q) * QUARTER) for q in quarters]
    first, second = (np.array([_offset(moment, zone, fold) for moment in naive])[place] for fold in (0, 1))
    twice = first > second
    back, number = np.append(False, np.diff(local) < -BACK) & twice, np.arange(len(local))
    last_back, last_once = (np.maximum.accumulate(np.where(each, number, -1)) for each in (back, ~twice))
    return local - np.where(last_back > last_once, second, first)


def offset_of_zone(seconds: float, zone: str) -> float:
    """How far a zone is ahead of UTC at a time (s since 1970), s."""
    offset = datetime.fromtimestamp(seconds, ZoneInfo(zone)).utcoffset()
    return offset.total_seconds() if offset else 0.0


def _offset(moment: datetime, zone: str, fold: int) -> float:
    offset = moment.replace(tzinfo=ZoneInfo(zone), fold=fold).utcoffset()
    return offset.total_seconds() if offset else 0.0
