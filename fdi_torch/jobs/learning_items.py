"""What a live source has delivered while a monitor learns, in a file beside the log.

The log begins with what was learnt. Until then this file has the rows and notices, so that a run that is killed while
it learns, which may take hours, can be resumed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import orjson

from fdi_torch.disk import named_errors
from fdi_torch.live.row_buffer import Row

Item = Row | str


class LearningItems:
    """The file of one log. Each line is a batch: time 0 of the source, s since 1970 or null, and its items."""

    def __init__(self, log: Path) -> None:
        self.path = log.with_name(f"{log.name}.learning")

    def read(self) -> tuple[list[Item], float | None]:
        """All items, and time 0; nothing without a file. A line that a killed run has not finished is left out."""
        items, origin = list[Item](), None
        if self.path.exists():
            with suppress(orjson.JSONDecodeError):
                for line in self.path.read_bytes().splitlines():
                    zero, batch = orjson.loads(line)
                    origin = zero if origin is None else origin
                    items += [item if isinstance(item, str) else _without_null(*item) for item in batch]
        return items, origin

    def keeping(self, batches: Iterator[list[Item]], origin: Callable[[], float | None]) -> Iterator[list[Item]]:
        """The batches, each added to the file before it is passed on. origin: time 0 of the source."""
        known = len(self.read()[0])  # a resumed run begins with them
        for batch in batches:
            with named_errors(self.path), self.path.open("ab") as file:
                file.write(orjson.dumps([origin(), batch[known:]]) + b"\n")
            known = max(known - len(batch), 0)
            yield batch

    def remove(self) -> None:
        """Remove the file, once the log has its items."""
        self.path.unlink(missing_ok=True)


def _without_null(time: float, *values: list[float | None]) -> Row:
    """A row with NaN for unknown values."""
    inputs, readings = ([math.nan if x is None else x for x in each] for each in values)
    return time, inputs, readings
