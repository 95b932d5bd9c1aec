"""The monitor job: run a monitor along a recording or a growing file, with everything in a log.

The result of a monitor is a function of the samples so far, identical to the last bit. A killed run is therefore
resumed by processing the logged samples again, which is a thousand times faster than real time.
"""

from __future__ import annotations

import math
import os
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import TypeVar

from fdi_torch.clock import clock_text, show_clock
from fdi_torch.config.growing_recordings import growing_rows
from fdi_torch.config.live_source import live_rows
from fdi_torch.config.loaded_recordings import expect_file, read_recording
from fdi_torch.config.monitor_file import MonitorRun
from fdi_torch.config.problems import naming_source
from fdi_torch.jobs.log_paths import RESUMES, left_unfinished, log_to_write, partial_path
from fdi_torch.jobs.logged_monitor import LoggedMonitor, MonitorCallbacks
from fdi_torch.jobs.monitor_rows import (
    ALARM,
    LearningItems,
    event_key,
    fault_free_recording,
    logged_items,
    logged_origin,
    logged_rows,
    resumed_items,
    rows_in,
    rows_until,
)
from fdi_torch.live.row_buffer import Row, RowSource
from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.logbook import RunLog
from fdi_torch.names import counted

IDLE = 60.0
"""Time without a sample after which a growing file counts as complete, s."""


@dataclass(frozen=True)
class MonitorSummary:
    """alarms: their number. lasted: duration of the recording, s. spent: computing time, s. log: path of the log."""

    alarms: int
    lasted: float
    spent: float
    log: Path


def run_monitor(
    run: MonitorRun, callbacks: MonitorCallbacks, follow: bool = False, idle: float | None = None, resume: bool = False
) -> MonitorSummary:
    """Prepare a monitor from the fault-free part and run it along the recording, or with `follow` along a growing file,
    or along a live source.

    Everything logged before an error or Ctrl-C is kept. idle: s without a sample after which the samples count as
    complete; by default 60 s for a growing file, and never for a live source. resume: continue a killed or interrupted
    run of the same file or source; the result is the same as without the interruption, and events in the earlier log
    are not reported again.
    """
    folder = Path(run.config.output.folder)
    if not resume and (left := left_unfinished(folder, run.name)):
        callbacks.note(f"{left}: log of a run that did not end; {RESUMES}, if the configuration is the same")
    path, unfinished = log_to_write(folder, run.name, run.text, resume)
    follow = follow or run.config.source is not None
    whole = None
    if not follow:
        callbacks.tell(0.0, "reading")
        with naming_source(run.source):
            expect_file(run.config.recording, "recording", run.base)
        whole = read_recording(run.config.recording, run.plant, run.base)
    kept = LearningItems(path) if run.config.source is not None else None
    earlier, origin = _earlier(run, unfinished, kept, resume) if follow else ([], None)
    messages = unfinished.messages([ALARM]) if unfinished is not None else ()
    reported = Counter(event_key(message.payload) for message in messages)
    if resume:
        rows = rows_in(earlier) or ([] if unfinished is None else logged_rows(unfinished, run))
        callbacks.note(_resumed_words(partial_path(path).name, rows, reported.total()))
    try:  # before the log begins, so that a source that cannot be reached leaves none
        source = _source(run, idle, origin, rows_in(earlier)) if follow else None
    except BaseException:
        if unfinished is not None:
            os.replace(unfinished.path, partial_path(path))  # for the next attempt to resume
        raise
    records = run.log_records([] if whole is None else [whole.origin])
    with RunLog(path, "monitor", **records, listener=callbacks.log, after_interruption=RESUMES) as log:
        monitor = LoggedMonitor(run, log, callbacks, reported)
        try:
            if source is not None:
                _follow(monitor, callbacks, source, earlier, kept)
            elif whole is not None:
                show_clock([whole.clock_zero])
                if run.config.recording.every > 1:  # the inputs' mean until the next kept sample is known only then
                    whole = whole.stretch(0, len(whole) - 1)
                monitor.process_recording(whole)
            monitor.close()
        finally:
            log.result({"events": monitor.events, "faults": monitor.faults()})
    return MonitorSummary(monitor.alarms, monitor.lasted, monitor.spent, path)


def _resumed_words(name: str, rows: Sequence[Row], events: int) -> str:
    """Say what a resumed run continues: the log's name, its last sample, and the number of its events."""
    if not rows:
        return f"resumed from {name}, which has no samples: starts from the beginning"
    return f"resumed from {name} at {rows[-1][0]:g} s; {counted(events, 'event')} already reported"


def _earlier(
    run: MonitorRun, unfinished: LoggedRun | None, kept: LearningItems | None, resume: bool
) -> tuple[list[Row | str], float | None]:
    """The items of a run to be resumed, and time 0 of its source: from its log, or kept while it learnt."""
    items = logged_items(unfinished, run) if unfinished is not None else []
    origin = logged_origin(unfinished) if unfinished is not None else None
    if kept is not None and resume:
        learning, zero = kept.read()
        if len(learning) > len(items):
            return learning, zero
    if kept is not None:
        kept.remove()
    return items, origin


def _source(run: MonitorRun, idle: float | None, origin: float | None, earlier_rows: Sequence[Row]) -> RowSource:
    """The rows of the live source, or else of the growing file."""
    if run.config.source is not None:
        return live_rows(run.config.source, run.plant, math.inf if idle is None else idle, origin, earlier_rows)
    return growing_rows(run.config.recording, run.plant, run.base, IDLE if idle is None else idle, origin)


def _follow(
    monitor: LoggedMonitor,
    callbacks: MonitorCallbacks,
    source: RowSource,
    earlier: Sequence[Row | str],
    kept: LearningItems | None,
) -> None:
    """Process samples as they come, after waiting for the end of the fault-free part.

    kept: the file that holds the samples of a live source while the monitor learns, because the log gets them only
    after the fault-free part has ended; a monitor that is killed before then resumes from this file.
    """
    run = monitor.run
    if kept is not None:  # the connection knows the earlier rows
        items = kept.keeping(chain(earlier, source), lambda: source.origin)
    else:
        items = resumed_items(earlier, source) if rows_in(earlier) else source
    batches = LiveBatches(items)
    callbacks.tell(None, "waiting for samples")
    first = _until_fault_free_part_ends(run, callbacks, batches)
    zero = source.origin
    show_clock([zero])
    monitor.learn(fault_free_recording(rows_in(first), run))
    if zero is not None:
        monitor.log_origin(zero)
    delay_watch, processed = DelayWatch(time.monotonic), 0
    for batch in chain([first], batches):
        rows = rows_in(batch)
        notices = delay_watch.received([row[0] for row in rows]) if rows else []
        if monitor.process_items([*notices, *batch]):
            delay_watch.clock_jumped()
        processed += len(batch)
        if kept is not None and processed >= kept.count:
            monitor.log.flush()
            kept.end()
            kept = None
        if rows:
            monitor.process_items(delay_watch.processed(rows[-1][0]))
            callbacks.tell(
                None, f"{_last_sample(rows)}, {delay_watch.delay:.1f} s behind; {counted(monitor.events, 'event')}"
            )


def _until_fault_free_part_ends(
    run: MonitorRun, callbacks: MonitorCallbacks, batches: Iterator[list[Row | str]]
) -> list[Row | str]:
    """Rows and notices up to the end of the fault-free part, or of the file."""
    items: list[Row | str] = []
    end = run.config.fault_free[1]
    for batch in batches:
        items += batch
        rows = rows_in(items)
        callbacks.tell(None, f"{_last_sample(rows)}, learning until {end:g} s" if rows else "waiting for samples")
        if rows_until(rows, end):
            break
    return items


def _last_sample(rows: Sequence[Row]) -> str:
    """The time of the last sample, and the moment if the clock has dates."""
    moment = clock_text(rows[-1][0])
    return f"last sample at {rows[-1][0]:g} s" + (f" ({moment})" if moment else "")


T = TypeVar("T")

LARGEST_BATCH = 4096
LATE, SILENT = 5.0, 2.0  # s of delay and of silence that are never reported
BURST_INTERVALS = 10.0  # a longer silence, in sampling intervals, followed by as many samples is a burst


class LiveBatches(Iterator[list[T]]):
    """Iterator over batches: all items that a thread has read from the source since the previous batch.

    An exception of the source is raised here, after the items before it. Ctrl-C interrupts the waiting.
    """

    def __init__(self, source: Iterator[T]) -> None:
        self._queue: queue.Queue[T | BaseException] = queue.Queue(LARGEST_BATCH)
        self._end: BaseException | None = None
        threading.Thread(target=self._read, args=(source,), daemon=True, name="live-batches").start()

    def _read(self, source: Iterator[T]) -> None:
        try:
            for item in source:
                self._queue.put(item)
            self._queue.put(StopIteration())
        except BaseException as error:
            self._queue.put(error)

    def __next__(self) -> list[T]:
        batch: list[T] = []
        while self._end is None and len(batch) < LARGEST_BATCH:
            try:
                item = self._queue.get_nowait() if batch else self._queue.get()
            except queue.Empty:
                return batch
            if isinstance(item, BaseException):
                self._end = item
            else:
                batch.append(item)
        if batch or self._end is None:
            return batch
        raise self._end


class DelayWatch:
    """Compares the plant's clock with real time, and reports processing delays and bursts after a silence.

    clock: real time in s. Each notice is given once, and again when the delay or the silence has doubled. delay: of the
    last processed sample against the least delayed one, s.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self.delay = clock, 0.0
        self._smallest_difference: float | None = None
        self._last_batch: float | None = None
        self._interval = 1.0
        self._reported_delay, self._reported_silence = LATE, SILENT

    def received(self, times: list[float]) -> list[str]:
        """Notices after a batch with the sample times `times` (s) was received."""
        now, notices = self._clock(), []
        gaps = sorted(b - a for a, b in pairwise(times) if b > a)
        self._interval = gaps[len(gaps) // 2] if gaps else self._interval
        if self._last_batch is not None:
            silence = now - self._last_batch
            burst = silence > BURST_INTERVALS * self._interval and len(times) > BURST_INTERVALS
            if burst and silence > 2.0 * self._reported_silence:
                self._reported_silence = silence
                notices.append(f"{len(times)} samples came at once after {silence:.1f} s of silence")
        self._last_batch = now
        return notices

    def processed(self, time: float) -> list[str]:
        """Notices after the sample with time `time` (s) was processed."""
        difference = self._clock() - time
        smallest = self._smallest_difference
        self._smallest_difference = difference if smallest is None else min(smallest, difference)
        self.delay = difference - self._smallest_difference
        if self.delay > 2.0 * self._reported_delay:
            self._reported_delay = self.delay
            return [f"the monitor is {self.delay:.1f} s behind real time"]
        return []

    def clock_jumped(self) -> None:
        """Restart the comparison after a jump of the plant's clock."""
        self._smallest_difference = None
