"""Clock times: the moment of a recording's time 0, by which seconds are shown as date and time too."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime, timedelta, timezone

MOMENTS = ("onset", "begin")
"""Names of effect parameters that are times of the recording, from its first sample on."""
_ZERO: ContextVar[float | None] = ContextVar("time 0 as the recording's clock showed it", default=None)
_FIRST: ContextVar[float | None] = ContextVar("time of the first sample of what is fitted, s", default=0.0)


def show_clock(zeros: Iterable[float | None], firsts: Iterable[float] = (0.0,)) -> None:
    """From now on, show clock times if all recordings have the same time 0, s since 1970 in their own zone.

    firsts: times of their first samples, s, from which the moments of their effects count.
    """
    _ZERO.set(_common(zeros))
    _FIRST.set(_common(firsts))


@contextmanager
def clock_shown(zeros: Iterable[float | None], firsts: Iterable[float] = (0.0,)) -> Iterator[None]:
    """Context within which clock times are shown as by `show_clock`."""
    tokens = _ZERO.set(_common(zeros)), _FIRST.set(_common(firsts))
    try:
        yield
    finally:
        _ZERO.reset(tokens[0])
        _FIRST.reset(tokens[1])


def clock_zero() -> float | None:
    """Time 0 as the recording's clock showed it, s since 1970; None if it has no dates."""
    return _ZERO.get()


def clock_text(seconds: float) -> str:
    """'2026-11-20 08:41:40' for a time of the recording (s); empty if its clock has no dates."""
    zero = _ZERO.get()
    try:
        return "" if zero is None else f"{datetime.fromtimestamp(round(zero + seconds), UTC):%Y-%m-%d %H:%M:%S}"
    except (OverflowError, ValueError, OSError):
        return ""


def clock_unit(unit: str, field: str, seconds: float) -> str:
    """The unit of a parameter, with the clock time if it is a time of the recording: 's (2026-11-20 08:41:40)'; without
    dates 's (at 700.1 s)' where the recording was cut, because a parameter counts from the first sample, in s.
    """
    first = _FIRST.get()
    if field not in MOMENTS or first is None:
        return unit
    moment = clock_text(first + seconds) or (f"at {first + seconds:.6g} s" if first else "")
    return f"{unit} ({moment})" if moment else unit


def stamp(began: float, zone: float) -> str:
    """'2026-11-20T08:30:00+01:00': a time in s since 1970, in a zone that many seconds ahead of UTC; empty for a time
    that has no date.
    """
    try:
        return datetime.fromtimestamp(began, timezone(timedelta(seconds=zone))).isoformat()
    except (OverflowError, ValueError, OSError):
        return ""


def of_stamp(text: str) -> tuple[float, float]:
    """Time in s since 1970 and zone in s of a stamp; the inverse of `stamp`. Raises ValueError."""
    moment = datetime.fromisoformat(text)
    offset = moment.utcoffset()
    return moment.timestamp(), offset.total_seconds() if offset else 0.0


def _common(zeros: Iterable[float | None]) -> float | None:
    different = set(zeros)
    return different.pop() if len(different) == 1 else None
