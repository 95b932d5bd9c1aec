"""Messages of any topic: encoded, numbered, each on a channel that describes its fields.

A topic's channel is registered with its first message. A later message with further fields gets a further channel of
the same topic, so that every message is described by a schema.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count, repeat
from typing import Any

import numpy as np
import orjson

from fdi_torch.logbook.block import Block, Timed, block_of
from fdi_torch.logbook.channel import Channel
from fdi_torch.logbook.payload import NON_FINITE, WALL, as_array, as_it_is, plain
from fdi_torch.logbook.schemas import FORMAT_VERSION, Kind, Topic, json_schema, named_kinds, topic_definition
from fdi_torch.logbook.sink import EPOCH_NS, log_time_of

Named = Mapping[str, Any]
_RESERVED = ("t", NON_FINITE, WALL, "masked")
_BLOCK = 4096
_FEW = 32
"""So few samples are written faster one by one."""
_TOGETHER, _TOGETHER_BYTES = 512, 1 << 22


@dataclass(frozen=True, eq=False)
class Trickle:
    """Messages of one topic that come one at a time and may be written a little later, many at a time.

    told: time and fields of each, worked out of what was kept for it, which must not have changed.
    """

    topic: str
    told: Callable[[Sequence[Any]], Iterable[tuple[float, Named]]]
    units: Mapping[str, str] | None = None


class Messages:
    """Encodes messages and hands them to `put`, with their log time in ns.

    What comes in a slow trickle can be put off (`later`), and is then encoded many at a time: a processor that has been
    busy with other things takes several times as long over each alone. keep((trickle, item)): the same with nothing
    else done, for what comes so often that even `later` counts; for when not `due`, after a first `later`.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._put_off: deque[tuple[Trickle, Any]] = deque()
        self._put_off_bytes = 0
        self.keep = self._put_off.append
        self.due = False
        self._latest = 0.0
        self._described: dict[str, tuple[frozenset[str], Channel]] = {}
        self._sequence: dict[str, int] = {}

    def put(self, messages: Iterable[Timed]) -> None:
        raise NotImplementedError

    def flush(self) -> None:
        raise NotImplementedError

    def put_block(self, block: Block) -> None:
        raise NotImplementedError

    def wall(self) -> dict[str, int]:
        raise NotImplementedError

    def write(
        self,
        topic: str,
        fields: Named,
        t: float | None = None,
        *,
        units: Mapping[str, str] | None = None,
        about: Mapping[str, str] | None = None,
        wall: bool = False,
    ) -> None:
        """One message. units: of named numbers; about: further metadata of the channel, heard at its first message.

        A field of value None is left out. Raises ValueError for a time that is not finite and for names taken already.
        """
        with self._lock:
            self.settle()
            self.put([self._timed(topic, fields, t, units, about, wall)])

    def _timed(
        self,
        topic: str,
        fields: Named,
        t: float | None,
        units: Mapping[str, str] | None,
        about: Mapping[str, str] | None = None,
        wall: bool = False,
    ) -> Timed:
        if "t" in fields:
            raise ValueError(f"{topic}: expected the time as argument, got it among the fields; remove it there")
        t = self._latest if t is None else float(t)
        if not math.isfinite(t):
            raise ValueError(f"{topic}: expected a finite time, got {t}; give the plant's time in s")
        message: Named = {"t": t, **fields}
        data = None if wall else as_it_is(message)
        if data is None:
            message = plain(message)
            data = orjson.dumps({**message, WALL: self.wall()} if wall else message)
        self._latest = max(self._latest, t)
        channel = self._channel(topic, fields, message, units, about)
        log_time = log_time_of(t)
        return channel, log_time, log_time, self._next(topic), data

    def later(self, trickle: Trickle, item: Any, size: int = 0) -> None:
        """One message, soon: before the next one that is written at once. size: about how many bytes the item keeps.

        The first of a topic is written at once, so that errors show.
        """
        if trickle.topic not in self._described:
            ((t, fields),) = trickle.told((item,))
            self.write(trickle.topic, fields, t, units=trickle.units)
            return
        self.keep((trickle, item))  # needs no lock, so that a search goes on at once
        self._put_off_bytes += size
        if self.due:
            self.flush()
        elif len(self._put_off) >= _TOGETHER or self._put_off_bytes > _TOGETHER_BYTES:
            self.settle()

    def settle(self) -> None:
        """Writes what was put off, in its order, though another thread puts off more meanwhile."""
        with self._lock:
            self._put_off_bytes = 0
            if self._put_off:
                self.put(self._settled())

    def _settled(self) -> Iterator[Timed]:
        while self._put_off:
            taken = [self._put_off.popleft() for _ in range(len(self._put_off))]
            items: dict[Trickle, list[Any]] = {}
            for trickle, item in taken:
                items.setdefault(trickle, []).append(item)
            told = {trickle: iter(trickle.told(own)) for trickle, own in items.items()}
            for trickle, _ in taken:
                t, fields = next(told[trickle])
                yield self._timed(trickle.topic, fields, t, trickle.units)

    def samples(
        self,
        topic: str,
        time: Any,
        values: Any,
        names: Sequence[str],
        units: Sequence[str],
        about: Mapping[str, str] | None = None,
    ) -> None:
        """A whole signal, values (T, N) over time (T,), one message a sample."""
        self.recording_blocks([(topic, as_array(values), names, units, None, about)], as_array(time))

    def recording(
        self,
        time: Any,
        inputs: Any,
        outputs: Any,
        input_names: Sequence[str],
        output_names: Sequence[str],
        input_units: Sequence[str],
        output_units: Sequence[str],
        *,
        mask: Any = None,
        hold: str = "zero_order",
        group: str = "",
    ) -> None:
        """A recording: `/plant/input` and `/plant/output` (`/plant/GROUP/...` where several are in one log).

        time (T,) in s, inputs (T, M), outputs (T, N), mask (T, N) True where a reading counts. NaN is kept.
        """
        root = f"/plant/{group}" if group else "/plant"
        mask = None if mask is None else as_array(mask).astype(bool)
        self.recording_blocks(
            [
                (f"{root}/input", as_array(inputs), input_names, input_units, None, {"hold": hold}),
                (f"{root}/output", as_array(outputs), output_names, output_units, mask, None),
            ],
            as_array(time),
        )

    def recording_blocks(self, signals: Sequence[tuple[Any, ...]], time: np.ndarray) -> None:
        """Several signals over one clock, sample by sample, in blocks that keep memory small."""
        for topic, values, names, *_ in signals:
            _check_signal(topic, values, names, len(time))
        if not np.isfinite(time).all():
            raise ValueError(f"{signals[0][0]}: expected finite times, got NaN or infinity; drop those samples")
        self.settle()
        topics = [topic for topic, *_ in signals]
        for first in range(0, len(time), _BLOCK):
            last = first + _BLOCK
            clock = time[first:last].astype(np.float64)
            log_times = EPOCH_NS + np.rint(clock * 1e9).astype(np.int64)
            blocks = [values[first:last].astype(np.float64) for _, values, *_ in signals]
            hidden = [
                np.zeros(0, bool) if mask is None else ~mask[first:last] & np.isfinite(block)
                for block, (*_, mask, _) in zip(blocks, signals, strict=True)
            ]
            for topic, _, names, units, _, about in signals:
                numbers = dict.fromkeys(names, 0.0)
                self._channel(topic, numbers, numbers, dict(zip(names, units, strict=True)), about)
            named = [names for _, _, names, *_ in signals]
            channels, sequences = self._follow(topics, len(clock))
            whole = all(np.isfinite(block).all() for block in blocks) and not any(part.any() for part in hidden)
            if whole and len(clock) > _FEW:
                self.put_block(block_of(channels, sequences, named, blocks, clock, log_times))
            else:
                encoded = [_rows(*parts, clock.tolist()) for parts in zip(named, blocks, hidden, strict=True)]
                self.put(_in_turn(channels, sequences, log_times.tolist(), encoded))
        self._latest = max(self._latest, float(time.max())) if len(time) else self._latest

    def _follow(self, topics: Sequence[str], count: int) -> tuple[list[Channel], list[int]]:
        """The channels of so many more messages of each topic, and the sequence numbers of the first ones."""
        sequences = [self._sequence.get(topic, 0) for topic in topics]
        self._sequence.update({topic: first + count for topic, first in zip(topics, sequences, strict=True)})
        return [self._described[topic][1] for topic in topics], sequences

    def follow_on(self, channel: Channel, sequence: int, t: float) -> None:
        """Number and describe what comes as if the message (channel, sequence, t) had just been written."""
        if self._described.get(channel.topic, (None, None))[1] != channel:
            properties = orjson.loads(channel.schema_data)["properties"]
            self._described[channel.topic] = (frozenset(properties), channel)
        self._sequence[channel.topic] = sequence + 1
        self._latest = max(self._latest, t)

    def sample(self, topic: str, t: float, values: Named, units: Mapping[str, str] | None = None) -> None:
        """One sample of a signal that arrives bit by bit, such as "/plant/output" or "/plant/truth"."""
        self.write(topic, values, t, units=units)

    def _channel(
        self,
        topic: str,
        fields: Named,
        message: Named,
        told_units: Mapping[str, str] | None,
        about: Mapping[str, str] | None,
    ) -> Channel:
        """The topic's channel; a new one where the message has fields that it does not describe."""
        known, channel = self._described.get(topic, (frozenset(), None))
        if channel is not None and known.issuperset(fields):
            return channel
        present = [name for name, value in fields.items() if value is not None]
        if channel is not None and known.issuperset(present):
            return channel
        definition = topic_definition(topic)
        named = named_kinds(definition, channel.schema_data) if channel else {}
        named.update({name: _kind(message.get(name)) for name in present if name not in definition.fields})
        _check_names(topic, definition, named)
        units = {f"unit.{name}": unit for name, (_, unit, _) in definition.fields.items() if unit}
        previous = dict(channel.metadata) if channel else {}
        pairs = {
            "schema_version": FORMAT_VERSION,
            "unit.t": "s",
            **units,
            **previous,
            **units_of(told_units),
            **(about or {}),
        }
        schema = json_schema(definition, named)
        channel = Channel(topic, "json", definition.schema, "jsonschema", schema, tuple(pairs.items()))
        self._described[topic] = (frozenset({"t", *definition.fields, *named}), channel)
        return channel

    def _next(self, topic: str) -> int:
        number = self._sequence.get(topic, 0)
        self._sequence[topic] = number + 1
        return number


def units_of(units: Mapping[str, str] | None) -> dict[str, str]:
    """Units as channel metadata: {"h1": "m"} -> {"unit.h1": "m"}."""
    return {f"unit.{name}": unit for name, unit in (units or {}).items()}


def _in_turn(
    channels: Sequence[Channel],
    sequences: Sequence[int],
    log_times: Sequence[int],
    encoded: Sequence[Sequence[bytes]],
) -> Iterator[Timed]:
    """One message of each channel a sample."""
    streams = [
        zip(repeat(channel), log_times, log_times, count(first), payloads, strict=False)
        for channel, first, payloads in zip(channels, sequences, encoded, strict=True)
    ]
    return chain.from_iterable(zip(*streams, strict=True))


def _rows(names: Sequence[str], block: np.ndarray, hidden: np.ndarray, clock: list[float]) -> list[bytes]:
    """Payloads of samples (B, N) among which some are not finite, or hidden (B, N) by the mask."""
    keys = ("t", *names)
    rows = zip(clock, *block.T.tolist(), strict=True)
    return [orjson.dumps(_row(keys, row, hidden[i : i + 1])) for i, row in enumerate(rows)]


def _row(keys: Sequence[str], row: Sequence[float], uncounted: np.ndarray) -> dict[str, Any]:
    hidden = zip(keys[1:], uncounted.ravel(), strict=True) if uncounted.size else ()
    masked = [name for name, is_hidden in hidden if is_hidden]
    return plain({**dict(zip(keys, row, strict=True)), "masked": masked or None})


def _check_signal(topic: str, values: np.ndarray, names: Sequence[str], samples: int) -> None:
    if values.shape != (samples, len(names)):
        raise ValueError(f"{topic}: expected values of shape {(samples, len(names))}, got {values.shape}")
    for name in names:
        if name in _RESERVED:
            raise ValueError(f"{topic}: expected a name other than {', '.join(_RESERVED)}, got {name}; rename it")


def _check_names(topic: str, definition: Topic, named: Mapping[str, Kind]) -> None:
    if named and not definition.named:
        raise ValueError(f"{topic}: expected only {', '.join(definition.fields)}, got {', '.join(named)}")
    for name in named:
        if name in (NON_FINITE, WALL):
            raise ValueError(f"{topic}: expected a name other than {NON_FINITE} and {WALL}, got {name}; rename it")


def _kind(value: Any) -> Kind:
    """JSON kind of a plain value; None stands for a number that was left out as non-finite."""
    if isinstance(value, list):
        first = value[0] if value else 0.0
        return "texts" if isinstance(first, str) else "integers" if type(first) is int else "numbers"
    if isinstance(value, bool):
        return "boolean"
    return "text" if isinstance(value, str) else "number"
