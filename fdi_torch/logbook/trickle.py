"""Messages that come one at a time and may be written a little later, many at a time.

A processor that has been busy with other things takes several times as long over each message alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_TOGETHER, _TOGETHER_BYTES = 512, 1 << 22


@dataclass(frozen=True, eq=False)
class Trickle:
    """Messages of one topic that may be put off.

    told: time (s) and fields of each, worked out of what was kept for it, which must not have changed.
    """

    topic: str
    told: Callable[[Sequence[Any]], Iterable[tuple[float, Mapping[str, Any]]]]
    units: Mapping[str, str] | None = None


class PutOff:
    """What was put off, in its order. keep((trickle, item)) needs no lock, so that a search goes on at once."""

    def __init__(self) -> None:
        self._items: deque[tuple[Trickle, Any]] = deque()
        self._bytes = 0
        self.keep = self._items.append

    def __bool__(self) -> bool:
        return bool(self._items)

    def add(self, trickle: Trickle, item: Any, size: int) -> None:
        """size: about how many bytes the item keeps alive."""
        self.keep((trickle, item))
        self._bytes += size

    @property
    def is_enough(self) -> bool:
        """Whether so much waits that it should be written now."""
        return len(self._items) >= _TOGETHER or self._bytes > _TOGETHER_BYTES

    def taken(self) -> Iterator[tuple[Trickle, float, Mapping[str, Any]]]:
        """Time (s) and fields of all that waits, though another thread puts off more meanwhile."""
        self._bytes = 0
        while self._items:
            now = [self._items.popleft() for _ in range(len(self._items))]
            items: dict[Trickle, list[Any]] = {}
            for trickle, item in now:
                items.setdefault(trickle, []).append(item)
            told = {trickle: iter(trickle.told(own)) for trickle, own in items.items()}
            for trickle, _ in now:
                yield trickle, *next(told[trickle])
