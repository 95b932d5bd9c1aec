"""Rows of samples from single values that may come late, repeatedly, or in any order.

Values of equal stamps form a row. A row is released `reorder` s after its first value arrived, together with all
earlier rows, so that rows leave in the order of their stamps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from fdi_torch.live.values import Value

MOST_REMEMBERED = 100_000
"""Stamps of released rows by which repeated values are recognised."""
JUMP = 10
"""Rows before the last released one, with none after it in between, that count as a jump of the source's clock. The
monitor likewise requires ten sampling intervals for a gap."""

Row = tuple[float, list[float], list[float]]
"""Time, s, the plant's inputs and its readings, SI; NaN for missing values."""


class RowSource(Iterator[Row | str]):
    """Rows as they come, and a sentence for each event of their source."""

    def __init__(self, rows: Iterator[Row | str], origin: Callable[[], float | None]) -> None:
        self._rows, self._origin = rows, origin

    @property
    def origin(self) -> float | None:
        """Time 0 of the rows, s since 1970; None before the first row, and if the clock has no date."""
        return self._origin()

    def __next__(self) -> Row | str:
        return next(self._rows)


@dataclass(frozen=True)
class LiveChannel:
    """A channel of the plant. tag: its address; None for a constant. number in SI = scale * number + shift.

    constant: value, SI, if there is no tag. held: time for which a value is kept while no new one comes, s.
    """

    name: str
    tag: str | None
    scale: float = 1.0
    shift: float = 0.0
    constant: float = math.nan
    held: float = 0.0


@dataclass
class _Pending:
    """A row that still may receive values. arrived: when its first value came, s."""

    arrived: float
    values: dict[int, float]


class RowBuffer:
    """Buffer that sorts values into rows.

    align: interval to whose multiples stamps are rounded, s; 0 for none. origin: stamp of time 0; None for the stamp of
    the first row with a reading if the clock has dates (`dated`), which is then available as `origin`, and 0 otherwise.
    Earlier rows are only kept as inputs: a source begins with the present value of each input, which may be hours old.
    seen: times of rows that are known from an earlier run.
    """

    def __init__(
        self,
        inputs: Sequence[LiveChannel],
        outputs: Sequence[LiveChannel],
        reorder: float,
        align: float = 0.0,
        dated: bool = False,
        origin: float | None = None,
        seen: Iterable[float] = (),
    ) -> None:
        self.channels = (*inputs, *outputs)
        self.origin = origin if dated or origin is not None else 0.0
        self._inputs, self._reorder, self._align = len(inputs), reorder, align
        self._places: Mapping[str, list[int]] = {
            c.tag: [k for k, other in enumerate(self.channels) if other.tag == c.tag] for c in self.channels if c.tag
        }
        self._pending: dict[float, _Pending] = {}
        self._late: dict[float, _Pending] = {}
        self._dated = dated
        self._released: dict[float, None] = dict.fromkeys(self._stamp((self.origin or 0.0) + t) for t in seen)
        self._last = max(self._released, default=-math.inf)
        self._held: dict[int, tuple[float, float]] = {}
        self._count, self._reported = 0, 1

    def put(self, value: Value, now: float) -> None:
        """Add a value that arrived at `now`, s of any monotonic clock."""
        if not math.isfinite(value.stamp):
            return
        stamp = self._stamp(value.stamp)
        if stamp in self._released:
            return
        rows = self._late if stamp <= self._last else self._pending
        row = rows.setdefault(stamp, _Pending(now, {}))
        for k in self._places.get(value.tag, ()):
            row.values[k] = self.channels[k].scale * value.number + self.channels[k].shift

    def rows(self, now: float, all_of_them: bool = False) -> list[Row | str]:
        """The rows to release at `now`, and notices about late ones."""
        notices = self._late_rows(now)
        old = [s for s, row in self._pending.items() if all_of_them or now - row.arrived >= self._reorder]
        last = max(old, default=-math.inf)
        due = [self._release(stamp) for stamp in sorted(s for s in self._pending if s <= last)]
        return [*notices, *(row for row in due if row is not None)]

    def _stamp(self, stamp: float) -> float:
        """The stamp by which a row is recognised: rounded to `align`, and seconds since 1970 to the microsecond."""
        if self._align:
            stamp = round(stamp / self._align) * self._align
        return round(stamp, 6) if self._dated or self._align else stamp

    def _late_rows(self, now: float) -> list[Row | str]:
        """Drop rows that came too late, or follow the source's clock back if only earlier rows come."""
        if self._pending and self._late:
            self._count += len(self._late)
            self._late = {}
        elif len(self._late) >= JUMP:
            self._pending, self._late, self._released = self._late, {}, {}
            self._last = -math.inf
            return ["the clock of the source went back"]
        if self._count < self._reported:
            return []
        self._reported = 2 * self._count
        return [
            f"samples more than {self._reorder:g} s late were left out, {self._count} so far; a longer source.reorder "
            "waits for them"
        ]

    def _release(self, stamp: float) -> Row | None:
        """The row with that stamp; None before the first reading."""
        received = self._pending.pop(stamp).values
        if self.origin is None and max(received, default=-1) >= self._inputs:
            self.origin = stamp
        self._last = stamp
        self._released[stamp] = None
        if len(self._released) > MOST_REMEMBERED:
            self._released.pop(next(iter(self._released)))
        values = [self._filled(k, received, stamp) for k in range(len(self.channels))]
        if self.origin is None:
            return None
        t = round(stamp - self.origin, 6) if self.origin else stamp
        return t, values[: self._inputs], values[self._inputs :]

    def _filled(self, k: int, found: Mapping[int, float], stamp: float) -> float:
        """The value of a channel in a row, or the last one while it is held."""
        channel = self.channels[k]
        if channel.tag is None:
            return channel.constant
        if k in found:
            self._held[k] = stamp, found[k]
            return found[k]
        since, value = self._held.get(k, (-math.inf, math.nan))
        return value if 0.0 <= stamp - since <= channel.held else math.nan
