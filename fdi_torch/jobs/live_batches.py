"""Live samples in batches, read by a thread, and notices about samples that come late or in a burst."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")

LARGEST_BATCH = 4096
LATE, SILENT = 5.0, 2.0  # s of delay and of silence that are never reported
BURST_INTERVALS = 10.0  # a longer silence, in sampling intervals, followed by as many samples is a burst


class _End:
    """Marks the end of the source."""


class LiveBatches(Iterator[list[T]]):
    """Iterator over batches: all items that a thread has read from the source since the previous batch.

    An exception of the source is raised here, after the items before it. Ctrl-C interrupts the waiting.
    """

    def __init__(self, source: Iterator[T]) -> None:
        self._queue: queue.Queue[T | BaseException | _End] = queue.Queue(LARGEST_BATCH)
        self._end: BaseException | None = None
        threading.Thread(target=self._read, args=(source,), daemon=True, name="live-batches").start()

    def _read(self, source: Iterator[T]) -> None:
        try:
            for item in source:
                self._queue.put(item)
            self._queue.put(_End())
        except BaseException as error:
            self._queue.put(error)

    def __next__(self) -> list[T]:
        batch: list[T] = []
        while self._end is None and len(batch) < LARGEST_BATCH:
            try:
                item = self._queue.get_nowait() if batch else self._queue.get()
            except queue.Empty:
                return batch
            if isinstance(item, _End):
                self._end = StopIteration()
            elif isinstance(item, BaseException):
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
