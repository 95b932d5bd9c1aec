"""A run done again from its own log, and held against what was logged, event by event."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import numpy as np
import orjson

from fdi_torch.logbook.compare import AXES
from fdi_torch.logbook.fingerprint import canonical
from fdi_torch.logbook.payload import NON_FINITE, WALL, unpack
from fdi_torch.logbook.provenance import environment
from fdi_torch.logbook.reader import Message, Run, read_run

Rerun = Callable[[Run], "str | Path | Iterable[Message]"]
Select = Callable[[Iterable[Message]], Iterable[Message]]
Outcome = Literal["bit-equal", "within tolerance", "differs"]


@dataclass(frozen=True)
class Difference:
    """An event that is not the same: its number among those compared (from 1), what it is, both sides as text."""

    event: int
    topic: str
    place: str
    field: str
    logged: str
    replayed: str


@dataclass(frozen=True)
class Replay:
    """outcome: bit-equal, within tolerance, or differs; the comparison ends with the first event that differs.

    events: how many were compared. first: the first beyond the tolerance. first_inexact: the first not bit-equal.
    largest: largest |a - b| / max(|a|, |b|) met. versions: what differs in the environment, name -> (then, now).
    """

    outcome: Outcome
    events: int
    first: Difference | None
    first_inexact: Difference | None
    largest: float
    versions: dict[str, tuple[str, str]]


def replay(
    path: str | Path,
    rerun: Rerun,
    *,
    relative: float = 1e-9,
    absolute: float = 1e-12,
    skip_topics: Collection[str] = ("/log",),
    select: Select | None = None,
    env: Mapping[str, str] | None = None,
) -> Replay:
    """Do a run again and compare.

    rerun: gets the opened log and returns the new log's path, or its messages. Numbers are within tolerance where
    |a - b| <= absolute + relative max(|a|, |b|). skip_topics: not compared; by default what is said in words.
    select: which messages of each side are compared, and in which order; by default all, as they were logged.
    Raises LogError where a log cannot be read.
    """
    run = read_run(path)
    again = rerun(run)
    replayed = read_run(again).messages() if isinstance(again, str | Path) else again
    return compare_events(
        *((select(side) if select else side) for side in (run.messages(), replayed)),
        relative=relative,
        absolute=absolute,
        skip_topics=skip_topics,
        versions=version_changes(run, environment() if env is None else env),
    )


def compare_events(
    logged: Iterable[Message],
    replayed: Iterable[Message],
    *,
    relative: float,
    absolute: float,
    skip_topics: Collection[str] = (),
    versions: dict[str, tuple[str, str]] | None = None,
) -> Replay:
    """Two streams of events in their order, up to the first that differs beyond the tolerance."""
    events, largest, first_inexact = 0, 0.0, None
    streams = ((m for m in stream if m.topic not in skip_topics) for stream in (logged, replayed))
    for events, (then, now) in enumerate(zip_longest(*streams), 1):
        for found in _deviations(then, now):
            difference = Difference(events, *_event(then, now), found.field, repr(found.then), repr(found.now))
            first_inexact = first_inexact or difference
            largest = max(largest, found.relative)
            if not found.within(relative, absolute):
                return Replay("differs", events, difference, first_inexact, largest, versions or {})
    outcome: Outcome = "bit-equal" if first_inexact is None else "within tolerance"
    return Replay(outcome, events, None, first_inexact, largest, versions or {})


def version_changes(run: Run, now: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """What of the environment is not as it was when the log was written."""
    then = run.metadata.get("fdi_torch.env", {})
    names = dict.fromkeys([*then, *now])
    return {name: (then.get(name, ""), now.get(name, "")) for name in names if then.get(name, "") != now.get(name, "")}


@dataclass(frozen=True)
class _Deviation:
    """One field on both sides."""

    field: str
    then: Any
    now: Any

    @property
    def numeric(self) -> bool:
        return all(isinstance(side, int | float) and math.isfinite(side) for side in (self.then, self.now))

    @property
    def relative(self) -> float:
        """|a - b| / max(|a|, |b|); infinite where the sides are no finite numbers."""
        if not self.numeric:
            return math.inf
        scale = max(abs(self.then), abs(self.now))
        return abs(self.then - self.now) / scale if scale else 0.0

    def within(self, relative: float, absolute: float) -> bool:
        if not self.numeric:
            return False
        return bool(abs(self.then - self.now) <= absolute + relative * max(abs(self.then), abs(self.now)))


def _deviations(then: Message | None, now: Message | None) -> Iterator[_Deviation]:
    """Fields that are not the same to the last bit."""
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
    """One deviation a field, or one an element of lists of equal length and of mappings, also where text tells them."""
    if isinstance(then, str) and isinstance(now, str) and then != now:
        then, now = _untold(then), _untold(now)
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for place, (a, b) in enumerate(zip(then, now, strict=True)):
            yield from _unequal(f"{name}[{place}]", a, b)
    elif isinstance(then, dict) and isinstance(now, dict):
        for key in dict.fromkeys([*then, *now]):
            yield from _unequal(f"{name}.{key}", then.get(key, "absent"), now.get(key, "absent"))
    elif not _same(then, now):
        yield _Deviation(name, then, now)


def _untold(text: str) -> Any:
    """What a text tells as JSON where it is a mapping or a list, or else the text."""
    if not text.startswith(("{", "[")):
        return text
    try:
        return orjson.loads(text)
    except ValueError:
        return text


def _same(then: Any, now: Any) -> bool:
    if isinstance(then, float) and isinstance(now, float):
        return np.float64(then).tobytes() == np.float64(now).tobytes() or (math.isnan(then) and math.isnan(now))
    return bool(then == now)


def _fields(message: Message) -> dict[str, Any]:
    """Fields of a message without wall time; packed arrays as lists of their elements."""
    payload = {name: value for name, value in message.payload.items() if name not in (WALL, NON_FINITE)}
    arrays = {name: array.ravel().tolist() for name, array in unpack(payload).items()}
    return payload | arrays


def _event(then: Message | None, now: Message | None) -> tuple[str, str]:
    """Topic of an event and which one it is."""
    message = then or now
    if message is None:
        return "", ""
    payload = message.payload
    axis = AXES.get(message.topic, "t")
    problem = f", problem {payload['problem']}" if payload.get("problem") else ""
    return message.topic, f"{axis} {payload.get(axis, message.t)}{problem}"
