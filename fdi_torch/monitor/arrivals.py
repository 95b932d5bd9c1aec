"""Samples that arrive in their own time: taken in batches, with a sentence on what comes late or in a burst."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")

MOST_TAKEN = 4096
LATE, SILENT = 5.0, 2.0  # s that are not worth a word
USUAL_GAPS = 10.0


class _End:
    """Nothing more comes."""


class Arrivals(Iterator[list[T]]):
    """What an iterator yields, drained by a thread and handed out as lists of all that has come by then.

    What the iterator raises is raised here, after what came before it. Ctrl-C is heard while waiting.
    """

    def __init__(self, source: Iterator[T]) -> None:
        self._queue: queue.Queue[T | BaseException | _End] = queue.Queue(MOST_TAKEN)
        self._end: BaseException | None = None
        threading.Thread(target=self._drain, args=(source,), daemon=True, name="arrivals").start()

    def _drain(self, source: Iterator[T]) -> None:
        try:
            for item in source:
                self._queue.put(item)
            self._queue.put(_End())
        except BaseException as error:
            self._queue.put(error)

    def __next__(self) -> list[T]:
        batch: list[T] = []
        while self._end is None and len(batch) < MOST_TAKEN:
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


class Punctuality:
    """Holds the plant's clock against the wall's: who is late, and what came at once after a silence.

    clock: wall time in s. Each sentence comes once, and again when it has become twice as bad.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._least: float | None = None
        self._last: float | None = None
        self._usual = 1.0
        self._told_late, self._told_silent = LATE, SILENT

    def arrived(self, times: list[float]) -> list[str]:
        """A batch was taken, its samples stamped `times` s."""
        now, said = self._clock(), []
        gaps = sorted(b - a for a, b in pairwise(times) if b > a)
        self._usual = gaps[len(gaps) // 2] if gaps else self._usual
        if self._last is not None:
            silence = now - self._last
            held_back = silence > USUAL_GAPS * self._usual and len(times) > USUAL_GAPS
            if held_back and silence > 2.0 * self._told_silent:
                self._told_silent = silence
                said.append(f"{len(times)} samples came at once after {silence:.1f} s of silence")
        self._last = now
        return said

    def handled(self, time: float) -> list[str]:
        """The sample stamped `time` has been dealt with."""
        behind = self._clock() - time
        self._least = behind if self._least is None else min(self._least, behind)
        late = behind - self._least
        if late > 2.0 * self._told_late:
            self._told_late = late
            return [f"what is said here is {late:.1f} s later than real time"]
        return []

    def restarted(self) -> None:
        """The plant's clock has jumped: the comparison starts afresh."""
        self._least = None
