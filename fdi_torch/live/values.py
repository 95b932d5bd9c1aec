"""What a live source delivers: values of tags, and the interface of the connections that deliver them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

MOST_WAITING = 200_000
"""Values that wait for the monitor, beyond which the oldest are dropped."""


@dataclass(frozen=True)
class Value:
    """A measured value. stamp: its time, s, by the clock of the source. number: NaN for a bad reading."""

    tag: str
    stamp: float
    number: float


Item = Value | str
"""A value, or a sentence about the connection for the log."""


class Connection(Protocol):
    """A connection to a live source, which is renewed after each loss.

    dated: whether stamps are seconds since 1970; otherwise they are plant time as it is.
    """

    dated: bool

    def read(self, timeout: float) -> list[Item]:
        """Everything that has arrived since the last call; waits up to `timeout` s for the first item.

        Raises ValueError if the source refuses the connection for good.
        """
        ...

    def close(self) -> None: ...


class Inbox:
    """Buffer between a network thread and the monitor. Of more than MOST_WAITING items, the oldest are dropped."""

    def __init__(self) -> None:
        self._items: deque[Item] = deque(maxlen=MOST_WAITING)
        self._arrived = threading.Condition()
        self._dropped = 0

    def put(self, items: Iterable[Item]) -> None:
        with self._arrived:
            before = len(self._items)
            added = 0
            for item in items:
                self._items.append(item)
                added += 1
            self._dropped += before + added - len(self._items)
            self._arrived.notify()

    def take(self, timeout: float) -> list[Item]:
        """All items; waits up to `timeout` s for the first."""
        with self._arrived:
            if not self._items:
                self._arrived.wait(timeout)
            items = list(self._items)
            self._items.clear()
            if self._dropped:
                items.insert(0, f"{self._dropped} values came faster than the monitor processes them and were dropped")
                self._dropped = 0
        return items


class BackOff:
    """Waiting times between attempts to connect, s: doubled after each failure up to `longest`."""

    def __init__(self, first: float = 0.5, longest: float = 30.0) -> None:
        self.first, self.longest = first, longest
        self._next = first

    def failed(self) -> float:
        """The time to wait before the next attempt."""
        wait, self._next = self._next, min(2.0 * self._next, self.longest)
        return wait

    def succeeded(self) -> None:
        self._next = self.first
