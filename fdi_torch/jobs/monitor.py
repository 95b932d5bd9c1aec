"""The monitor job: run a monitor along a recording or a growing file, with everything in a log.

The result of a monitor is a function of the samples so far, identical to the last bit. A killed run is therefore
resumed by processing the logged samples again, which is a thousand times faster than real time.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from fdi_torch.clock import clock_text, show_clock
from fdi_torch.config.growing_recordings import Row, growing_rows
from fdi_torch.config.live_source import LiveRows
from fdi_torch.config.loaded_recordings import read_recording
from fdi_torch.config.monitor_file import MonitorRun
from fdi_torch.jobs.event_messages import event_key
from fdi_torch.jobs.live_batches import DelayWatch, LiveBatches
from fdi_torch.jobs.log_paths import RESUMES, expect_unfinished, free_path, partial_path
from fdi_torch.jobs.logged_monitor import LoggedMonitor, MonitorCallbacks
from fdi_torch.jobs.monitor_rows import (
    ALARM,
    logged_items,
    logged_origin,
    recording_of_rows,
    resumed_items,
    rows_until,
)
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
    path, unfinished = _log_to_write(run, resume)
    follow = follow or run.config.source is not None
    if not follow:
        callbacks.tell(0.0, "reading")
    whole = None if follow else read_recording(run.config.recording, run.plant, run.base, run.given)
    earlier = logged_items(unfinished, run) if follow and unfinished is not None else []
    origin = logged_origin(unfinished) if unfinished is not None else None
    messages = unfinished.messages([ALARM]) if unfinished is not None else ()
    reported = Counter(event_key(message.payload) for message in messages)
    zeros: list[float] = []
    try:  # before the log begins, so that a source that cannot be reached leaves none
        source = _source(run, idle, origin, _rows(earlier), zeros) if follow else iter(())
    except BaseException:
        if unfinished is not None:
            os.replace(unfinished.path, partial_path(path))  # for the next attempt to resume
        raise
    records = run.log_records([] if whole is None else [whole.origin])
    with RunLog(path, "monitor", **records, listener=callbacks.log, after_interruption=RESUMES) as log:
        monitor = LoggedMonitor(run, log, callbacks, reported)
        try:
            if whole is None:
                _follow(monitor, callbacks, source, earlier, zeros)
            else:
                show_clock([whole.clock_zero])
                if run.config.recording.every > 1:  # the inputs' mean until the next kept sample is known only then
                    whole = whole.stretch(0, len(whole) - 1)
                monitor.process_recording(whole)
            monitor.close()
        finally:
            log.result({"events": monitor.events, "faults": monitor.faults()})
    return MonitorSummary(monitor.alarms, monitor.lasted, monitor.spent, path)


def _log_to_write(run: MonitorRun, resume: bool) -> tuple[Path, LoggedRun | None]:
    """Path of the log to write, and with `resume` the unfinished log to continue."""
    folder = Path(run.config.output.folder)
    return expect_unfinished(folder, run.name, run.text) if resume else (free_path(folder, run.name), None)


def _source(
    run: MonitorRun, idle: float | None, origin: float | None, earlier_rows: Sequence[Row], zeros: list[float]
) -> Iterator[Row | str]:
    """The rows of the live source, or else of the growing file, whose time 0 is appended to `zeros`."""
    if run.config.source is not None:
        return LiveRows(run.config.source, run.plant, math.inf if idle is None else idle, origin, earlier_rows)
    return growing_rows(run.config.recording, run.plant, run.base, IDLE if idle is None else idle, zeros.append)


def _follow(
    monitor: LoggedMonitor,
    callbacks: MonitorCallbacks,
    source: Iterator[Row | str],
    earlier: Sequence[Row | str],
    zeros: list[float],
) -> None:
    """Process samples as they come, after waiting for the end of the fault-free part."""
    run = monitor.run
    batches = LiveBatches(resumed_items(earlier, source) if _rows(earlier) else source)
    callbacks.tell(None, "waiting for samples")
    first = _until_fault_free_part_ends(run, callbacks, batches)
    zero = source.origin if isinstance(source, LiveRows) else next(iter(zeros), None)
    show_clock([zero])
    rows = _rows(first)
    monitor.learn(recording_of_rows(rows_until(rows, run.config.fault_free[1]) or rows, run))
    if zero is not None:
        monitor.log_origin(zero)
    delay_watch = DelayWatch(time.monotonic)
    for batch in chain([first], batches):
        rows = _rows(batch)
        notices = delay_watch.received([row[0] for row in rows]) if rows else []
        if monitor.process_items([*notices, *batch]):
            delay_watch.clock_jumped()
        if rows:
            monitor.process_items(delay_watch.processed(rows[-1][0]))
            callbacks.tell(
                None, f"{_last_sample(rows)}, {delay_watch.delay:.1f} s behind; {counted(monitor.events, 'event')}"
            )


def _until_fault_free_part_ends(
    run: MonitorRun, callbacks: MonitorCallbacks, batches: LiveBatches[Row | str]
) -> list[Row | str]:
    """Rows and notices up to the end of the fault-free part, or of the file."""
    items: list[Row | str] = []
    end = run.config.fault_free[1]
    for batch in batches:
        items += batch
        rows = _rows(items)
        callbacks.tell(None, f"{_last_sample(rows)}, learning until {end:g} s" if rows else "waiting for samples")
        if rows_until(rows, end):
            break
    return items


def _last_sample(rows: Sequence[Row]) -> str:
    """The time of the last sample, and the moment if the clock has dates."""
    moment = clock_text(rows[-1][0])
    return f"last sample at {rows[-1][0]:g} s" + (f" ({moment})" if moment else "")


def _rows(items: Iterable[Row | str]) -> list[Row]:
    return [item for item in items if not isinstance(item, str)]
