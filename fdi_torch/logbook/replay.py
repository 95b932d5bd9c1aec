"""Replay: a run is repeated from its own log and compared with it, event by event."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import numpy as np
import orjson

from fdi_torch.logbook.compare import AXES, canonical
from fdi_torch.logbook.payload import NON_FINITE, WALL, unpack
from fdi_torch.logbook.provenance import environment
from fdi_torch.logbook.reader import Message, Run, read_run

Rerun = Callable[[Run], "str | Path | Iterable[Message]"]
Select = Callable[[Iterable[Message]], Iterable[Message]]
Outcome = Literal["bit-equal", "within tolerance", "differs"]
ABSOLUTE, RELATIVE = 1e-12, 1e-9
"""Absolute and relative part of the tolerance of a number."""
UNFINISHED = ("", "interrupted", "failed")
"""Statuses of a run that did not come to its end; a killed one has none."""


@dataclass(frozen=True)
class Difference:
    """The first differing field of an event: its number among those compared (from 1), its place, both values."""

    event: int
    topic: str
    place: str
    field: str
    logged: str
    replayed: str


@dataclass(frozen=True)
class Replay:
    """outcome: bit-equal, within tolerance, or differs; the comparison ends at the first event that differs.

    events: number of compared events. first: the first difference beyond the tolerance. first_inexact: the first that
    is not bit-equal. largest: largest |a - b| / max(|a|, |b|). versions: differences of the environment, name -> (then,
    now).
    """

    outcome: Outcome
    events: int
    first: Difference | None
    first_inexact: Difference | None
    largest: float
    versions: dict[str, tuple[str, str]]


def replay(
    path: str | Path, rerun: Rerun, *, select: Select | None = None, env: Mapping[str, str] | None = None
) -> Replay:
    """Repeat a run and compare it with its log.

    rerun: receives the opened log and returns the new log's path, or its messages. Numbers are within tolerance if |a -
    b| <= ABSOLUTE + RELATIVE max(|a|, |b|). select: chooses and orders the messages to compare on each side; by default
    all as logged. Sentences on `/log` are not compared. Of a run that did not come to its end, the logged events are
    compared with the first ones of the replay. Raises LogError for an unreadable log.
    """
    run = read_run(path)
    repeated = rerun(run)
    replayed = read_run(repeated).messages() if isinstance(repeated, str | Path) else repeated
    logged, again = (select(side) if select else side for side in (run.messages(), replayed))
    changes = version_changes(run, environment() if env is None else env)
    return compare_events(logged, again, changes, run.about("status").get("status", "") in UNFINISHED)


def compare_events(
    logged: Iterable[Message],
    replayed: Iterable[Message],
    versions: dict[str, tuple[str, str]],
    unfinished: bool = False,
) -> Replay:
    """Compare two ordered streams of events, up to the first difference beyond the tolerance, or up to the last logged
    event of an unfinished run.
    """
    events, largest, first_inexact = 0, 0.0, None
    streams = ((m for m in stream if m.topic != "/log") for stream in (logged, replayed))
    for then, now in zip_longest(*streams):
        if then is None and unfinished:
            break
        events += 1
        for deviation in _deviations(then, now):
            event = _event(then or now)  # one of both is there
            difference = Difference(events, *event, deviation.field, repr(deviation.then), repr(deviation.now))
            first_inexact = first_inexact or difference
            largest = max(largest, deviation.relative)
            if not deviation.within:
                return Replay("differs", events, difference, first_inexact, largest, versions)
    outcome: Outcome = "bit-equal" if first_inexact is None else "within tolerance"
    return Replay(outcome, events, None, first_inexact, largest, versions)


def version_changes(run: Run, now: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Differences of the environment since the log was written."""
    then = run.about("env")
    pairs = {name: (then.get(name, ""), now.get(name, "")) for name in dict.fromkeys([*then, *now])}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


@dataclass(frozen=True)
class _Deviation:
    """One differing field with both values."""

    field: str
    then: Any
    now: Any

    @property
    def numeric(self) -> bool:
        return all(isinstance(side, int | float) and math.isfinite(side) for side in (self.then, self.now))

    @property
    def relative(self) -> float:
        """|a - b| / max(|a|, |b|); infinite unless both are finite numbers."""
        if not self.numeric:
            return math.inf
        scale = max(abs(self.then), abs(self.now))
        return abs(self.then - self.now) / scale if scale else 0.0

    @property
    def within(self) -> bool:
        if not self.numeric:
            return False
        return bool(abs(self.then - self.now) <= ABSOLUTE + RELATIVE * max(abs(self.then), abs(self.now)))


def _deviations(then: Message | None, now: Message | None) -> Iterator[_Deviation]:
    """Fields that are not bitwise equal."""
    if then is None or now is None:
        yield _Deviation("event", *("missing" if side is None else "there" for side in (then, now)))
    elif then.topic != now.topic:
        yield _Deviation("topic", then.topic, now.topic)
    elif then.log_time != now.log_time or canonical(then) != canonical(now):
        if then.log_time != now.log_time:
            yield _Deviation("log time", then.t, now.t)
        a, b = _fields(then), _fields(now)
        for name in dict.fromkeys([*a, *b]):
            yield from _unequal(name, a.get(name, "absent"), b.get(name, "absent"))


def _unequal(name: str, then: Any, now: Any) -> Iterator[_Deviation]:
    """Deviations of a field: one per element of lists of equal length and of mappings, also within JSON texts."""
    if isinstance(then, str) and isinstance(now, str) and then != now:
        then, now = _parsed(then), _parsed(now)
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for place, (a, b) in enumerate(zip(then, now, strict=True)):
            yield from _unequal(f"{name}[{place}]", a, b)
    elif isinstance(then, dict) and isinstance(now, dict):
        for key in dict.fromkeys([*then, *now]):
            yield from _unequal(f"{name}.{key}", then.get(key, "absent"), now.get(key, "absent"))
    elif not _same(then, now):
        yield _Deviation(name, then, now)


def _parsed(text: str) -> Any:
    """The value of a JSON text that is a mapping or a list; other texts unchanged."""
    with suppress(ValueError):
        return orjson.loads(text) if text.startswith(("{", "[")) else text
    return text


def _same(then: Any, now: Any) -> bool:
    if isinstance(then, float) and isinstance(now, float):
        return np.float64(then).tobytes() == np.float64(now).tobytes() or (math.isnan(then) and math.isnan(now))
    return bool(then == now)


def _fields(message: Message) -> dict[str, Any]:
    """Fields of a message without wall time; packed arrays as lists."""
    payload = {name: value for name, value in message.payload.items() if name not in (WALL, NON_FINITE)}
    arrays = {name: array.ravel().tolist() for name, array in unpack(payload).items()}
    return payload | arrays


def _event(message: Message) -> tuple[str, str]:
    """The topic of an event and its position."""
    payload, axis = message.payload, AXES.get(message.topic, "t")
    problem = f", problem {payload['problem']}" if payload.get("problem") else ""
    return message.topic, f"{axis} {payload.get(axis, message.t)}{problem}"
