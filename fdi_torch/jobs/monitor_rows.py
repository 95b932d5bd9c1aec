"""Rows read from a growing file, converted to samples and to the recording from which a monitor learns its noise; and
the samples and events in a monitor's log.
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from io import FileIO
from itertools import chain, pairwise, takewhile
from pathlib import Path
from typing import Any

import orjson
import torch

from fdi_torch.config.monitor_file import MonitorRun
from fdi_torch.disk import named_errors
from fdi_torch.live.row_buffer import Row
from fdi_torch.logbook import Run as Log
from fdi_torch.logbook import series
from fdi_torch.monitor.events import FORMAT, Event
from fdi_torch.monitor.samples import GAP, Samples
from fdi_torch.recording import Recording

ALARM, CLOCK = "/observer/alarm", "/source/clock"
FROM_SOURCE = "from_source"
"""Field of an alarm message: whether it is a notice about the delivery of samples."""


def samples_of_rows(rows: Sequence[Row], run: MonitorRun) -> Samples:
    """The rows as samples, in SI."""
    time, inputs, readings = (torch.tensor(column, dtype=torch.float64) for column in zip(*rows, strict=True))
    sensors = len(run.plant.sensors)
    return Samples(time, inputs.reshape(len(time), -1), readings.reshape(-1, sensors), run.config.recording.hold)


def rows_in(items: Iterable[Row | str]) -> list[Row]:
    """The rows among rows and notices."""
    return [item for item in items if not isinstance(item, str)]


def rows_until(rows: Sequence[Row], until: float) -> list[Row]:
    """The first segment of rows without a backward jump of the clock that reaches a time (s); empty if none does yet.

    One row with a time far ahead does not count as reaching it; after a gap, GAP rows are required.
    """
    segment: list[Row] = []
    steps: list[float] = []
    beyond = 0
    for row in rows:
        step = row[0] - segment[-1][0] if segment else 0.0
        if step == 0.0 and segment:
            continue
        if step < 0.0:
            segment, steps, beyond = [], [], 0
        elif segment:
            steps.append(step)
        segment.append(row)
        if row[0] < until:
            continue
        beyond += 1
        if beyond >= GAP or (beyond == 1 and steps and step <= GAP * sorted(steps)[len(steps) // 2]):
            return segment
    return []


def fault_free_recording(rows: Sequence[Row], run: MonitorRun) -> Recording:
    """The first rows up to the end of the fault-free part, or else all after the last jump of the clock."""
    rows = rows_until(rows, run.config.fault_free[1]) or rows
    if len(rows) < 2:
        raise ValueError(
            f"{run.config.recording.file}: expected samples to follow, got {len(rows)}; check that the plant delivers "
            "samples, and that columns or tags have the names that the source uses"
        )
    unique = [rows[0], *(after for before, after in pairwise(rows) if after[0] != before[0])]
    jumps = [k for k in range(1, len(unique)) if unique[k][0] < unique[k - 1][0]]
    samples = samples_of_rows(unique[jumps[-1] if jumps else 0 :], run)
    return run.plant.recording(
        samples.time, samples.inputs, samples.readings, hold=samples.hold, source=run.config.recording.file
    )


def logged_rows(log: Log, run: MonitorRun) -> list[Row]:
    """The samples in a monitor's log, in their original order."""
    inputs, outputs = series(log, "/plant/input"), series(log, "/plant/output")
    count = min(len(inputs["t"]), len(outputs["t"]))  # a run may have been killed between the two messages
    if not count:  # it may also have been killed before its first sample, when no channel is named yet
        return []
    commands = [inputs[name][:count] for name in run.plant.channels()]
    readings = [outputs[sensor.column][:count] for sensor in run.plant.sensors]
    times = inputs["t"][:count].tolist()
    return [(t, [float(c[k]) for c in commands], [float(r[k]) for r in readings]) for k, t in enumerate(times)]


def logged_items(log: Log, run: MonitorRun) -> list[Row | str]:
    """The samples in a monitor's log and the notices of their source, in their original order."""
    rows, items = iter(logged_rows(log, run)), list[Row | str]()
    for message in log.messages(["/plant/output", ALARM]):
        if message.topic != ALARM:
            items += [row for row in [next(rows, None)] if row is not None]
        elif message.payload.get(FROM_SOURCE):
            items.append(message.payload["message"])
    return items


def logged_origin(log: Log) -> float | None:
    """Time 0 of a live source in a monitor's log, s since 1970; None if its clock has no date."""
    return next((float(message.payload["origin"]) for message in log.messages([CLOCK])), None)


def resumed_items(earlier: Sequence[Row | str], source: Iterable[Row | str]) -> Iterator[Row | str]:
    """Rows and notices of an earlier log, and then what the growing file has beyond them.

    The file begins with one of the logged rows, the first unless it was rotated, and repeats those after it; otherwise
    it was rotated after the last one.
    """
    yield from earlier
    rows = rows_in(earlier)
    later, head = iter(source), list[Row | str]()
    for item in later:
        head.append(item)
        if not isinstance(item, str):
            break
    begins = (k for k, row in enumerate(rows) if head and not isinstance(head[-1], str) and _equal_rows(head[-1], row))
    first = next(begins, len(rows))
    later, repeated = chain(head, later), first
    for item in later if first < len(rows) else ():
        repeated += not isinstance(item, str)
        if repeated == len(rows):
            break
    logged = Counter(takewhile(lambda item: isinstance(item, str), reversed(earlier)))
    for item in later:
        if isinstance(item, str) and logged[item] > 0:
            logged[item] -= 1
        else:
            yield item


def _equal_rows(a: Row, b: Row) -> bool:
    """Whether two rows have equal values; NaN equals NaN."""
    first, second = ([r[0], *r[1], *r[2]] for r in (a, b))
    return len(first) == len(second) and all(x == y or (x != x and y != y) for x, y in zip(first, second, strict=True))


def event_key(payload: dict[str, Any]) -> tuple[Any, ...]:
    """Key by which a logged event is recognised in another log."""
    return payload["t"], payload["event"], payload["message"]


def event_fields(event: Event) -> dict[str, Any]:
    """An event's fields for the log: numbers, texts and flat lists, and the whole event as JSON in `details`."""
    return {
        "alarm": event.alarm or None,
        "state": str(event.state),
        "headline": event.headline if event.explanations else None,
        "faults": list(event.faults) or None,
        "sizes": list(event.sizes) or None,
        "stds": list(event.stds) or None,
        "units": list(event.units) or None,
        "onset": event.onset,
        "onset_std": event.onset_std,
        "delay": event.delay,
        "growing": event.growing if event.faults else None,
        "explanations": [e.text for e in event.explanations] or None,
        "masses": [e.mass for e in event.explanations] or None,
        "sensors": [name for name, _ in event.shares] or None,
        "shares": [share for _, share in event.shares] or None,
        "first": event.first,
        "last": event.last,
        "count": event.count,
        "severity": event.severity or None,
        "announced": event.announced,
        "format": FORMAT,
        "details": orjson.dumps(event.to_dict()).decode(),
    }


class LearningItems:
    """What a live source delivers while a monitor learns, which may take hours, in a file beside the log: a run that is
    killed before the log has these items can be resumed.

    Each line is time 0 of the source, s since 1970 or null, and a list of items. count: items delivered so far.
    """

    def __init__(self, log: Path) -> None:
        self.path = log.with_name(f"{log.name}.learning")
        self.count, self._ended, self._writing = 0, False, threading.Lock()
        self._file: FileIO | None = None

    def read(self) -> tuple[list[Row | str], float | None]:
        """All items, and time 0; nothing without a file. A line that a killed run has not finished is left out."""
        items, origin = list[Row | str](), None
        if self.path.exists():
            with suppress(orjson.JSONDecodeError):
                for line in self.path.read_bytes().split(b"\n")[:-1]:
                    zero, some = orjson.loads(line)
                    origin = zero if origin is None else origin
                    items += [item if isinstance(item, str) else _without_null(*item) for item in some]
        return items, origin

    def keeping(self, items: Iterator[Row | str], origin: Callable[[], float | None]) -> Iterator[Row | str]:
        """The items, each added to the file before it is passed on, until `end`; to be read by the thread that reads
        the source, because learning occupies the other one. origin: time 0 of the source."""
        known = len(self.read()[0])  # a resumed run begins with them
        try:
            for item in items:
                with self._writing:
                    self.count += 1
                    if self.count > known and not self._ended:
                        self._append(orjson.dumps([origin(), [item]]))
                yield item
        finally:
            self._close()

    def _append(self, line: bytes) -> None:
        """Add a line, which is on its way to the disk at once, so that a killed run has left it."""
        remaining = line + b"\n"
        with named_errors(self.path):
            self._file = self._file or self._opened()
            while remaining:  # a full disk takes a part of it and refuses the next
                remaining = remaining[self._file.write(remaining) :]

    def _opened(self) -> FileIO:
        """The file without an unfinished last line, to which the next one would be joined."""
        file = self.path.open("ab", buffering=0)
        file.truncate(self.path.read_bytes().rfind(b"\n") + 1)
        return file

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()

    def end(self) -> None:
        """Keep nothing more, and remove the file, since the log has its items."""
        with self._writing:
            self._ended = True
            self._close()
            self.remove()

    def remove(self) -> None:
        """Remove the file of an earlier run."""
        self.path.unlink(missing_ok=True)


def _without_null(time: float, *values: list[float | None]) -> Row:
    """A row with NaN for unknown values."""
    inputs, readings = ([math.nan if x is None else x for x in each] for each in values)
    return time, inputs, readings
