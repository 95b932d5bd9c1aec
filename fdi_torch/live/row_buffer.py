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
"""Released rows by which repeated values are recognised."""
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
    earlier: rows of an earlier run that goes on; its inputs are still held.
    """

    def __init__(
        self,
        inputs: Sequence[LiveChannel],
        outputs: Sequence[LiveChannel],
        reorder: float,
        align: float = 0.0,
        dated: bool = False,
        origin: float | None = None,
        earlier: Iterable[Row] = (),
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
        self._released: dict[float, list[float]] = {}
        self._last = -math.inf
        for t, commands, readings in earlier:
            self._remember(self._stamp((self.origin or 0.0) + t), [*commands, *readings])
        latest = enumerate(self._released.get(self._last, ()))
        self._held: dict[int, tuple[float, float]] = {k: (self._last, value) for k, value in latest}
        self._count, self._reported = 0, 1

    def put(self, value: Value, now: float) -> None:
        """Add a value that arrived at `now`, s of any monotonic clock."""
        if not math.isfinite(value.stamp):
            return
        stamp = self._stamp(value.stamp)
        if stamp == self._last:
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
        """Drop rows that are repeated or came too late, or follow the source's clock back if only earlier rows come."""
        due = [stamp for stamp, row in self._late.items() if now - row.arrived >= self._reorder]
        repeated = [stamp for stamp in due if self._is_repeated(stamp)]
        if not self._pending and len(due) - len(repeated) >= JUMP:
            return self._gone_back()
        self._count += len(due) - len(repeated) if self._pending else 0
        for stamp in due if self._pending else repeated:
            del self._late[stamp]
        if self._count < self._reported:
            return []
        self._reported = 2 * self._count
        return [
            f"samples more than {self._reorder:g} s late were left out, {self._count} so far; a longer source.reorder "
            "waits for them"
        ]

    def _is_repeated(self, stamp: float) -> bool:
        """Whether a late row has only values that the row of that stamp had already."""
        known = self._released.get(stamp)
        return known is not None and all(
            x == known[k] or (x != x and known[k] != known[k]) for k, x in self._late[stamp].values.items()
        )

    def _gone_back(self) -> list[Row | str]:
        """Follow the source's clock back to the late rows. Values that are held keep their age."""
        back = min(self._late) - self._last
        self._held = {k: (since + back, value) for k, (since, value) in self._held.items()}
        self._pending, self._late, self._released = self._late, {}, {}
        self._last = -math.inf
        return ["the clock of the source went back"]

    def _release(self, stamp: float) -> Row | None:
        """The row with that stamp; None before the first reading."""
        received = self._pending.pop(stamp).values
        if self.origin is None and max(received, default=-1) >= self._inputs:
            self.origin = stamp
        values = [self._filled(k, received, stamp) for k in range(len(self.channels))]
        self._remember(stamp, values)
        if self.origin is None:
            return None
        t = round(stamp - self.origin, 6) if self.origin else stamp
        return t, values[: self._inputs], values[self._inputs :]

    def _remember(self, stamp: float, values: list[float]) -> None:
        """Remember the values of a released row; those before a backward jump of the clock are forgotten."""
        if stamp < self._last:
            self._released = {}
        self._last = stamp
        self._released[stamp] = values
        if len(self._released) > MOST_REMEMBERED:
            self._released.pop(next(iter(self._released)))

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
