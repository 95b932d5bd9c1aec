"""Buffer for messages that arrive one at a time and are encoded many at a time.

A processor busy with other work takes several times as long to encode each message alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_TOGETHER, _TOGETHER_BYTES = 512, 1 << 22


@dataclass(frozen=True, eq=False)
class DeferredTopic:
    """Messages of one topic that may be deferred.

    encode: time (s) and fields of each buffered item, computed when they are written; the items must not change
    meanwhile.
    """

    topic: str
    encode: Callable[[Sequence[Any]], Iterable[tuple[float, Mapping[str, Any]]]]
    units: Mapping[str, str] | None = None


class WriteBuffer:
    """Deferred messages in their order. keep((topic, item)) needs no lock, so that the caller does not wait."""

    def __init__(self) -> None:
        self._items: deque[tuple[DeferredTopic, Any]] = deque()
        self._bytes = 0
        self.keep = self._items.append

    def __bool__(self) -> bool:
        return bool(self._items)

    def add(self, topic: DeferredTopic, item: Any, size: int) -> None:
        """Add an item; size: its memory, bytes."""
        self.keep((topic, item))
        self._bytes += size

    @property
    def is_enough(self) -> bool:
        """Whether the buffer is full enough to be written."""
        return len(self._items) >= _TOGETHER or self._bytes > _TOGETHER_BYTES

    def taken(self) -> Iterator[tuple[DeferredTopic, float, Mapping[str, Any]]]:
        """Topic, time (s) and fields of all buffered messages, also while another thread adds more."""
        self._bytes = 0
        while self._items:
            batch = [self._items.popleft() for _ in range(len(self._items))]
            items: dict[DeferredTopic, list[Any]] = {}
            for topic, item in batch:
                items.setdefault(topic, []).append(item)
            messages = {topic: iter(topic.encode(of_topic)) for topic, of_topic in items.items()}
            for topic, _ in batch:
                yield topic, *next(messages[topic])
