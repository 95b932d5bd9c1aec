"""Messages as arrays: fields of any topic over time, and the recording in a log of this or another program."""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson

from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.reader import Message, Run
from fdi_torch.logbook.sink import EPOCH_NS
from fdi_torch.logbook.topic_definitions import Channel, topic_definition
from fdi_torch.untrusted_input import MOST_ARRAY_BYTES, MOST_ARRAY_EXPANSION, expect_unpacked

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")  # a name or an index of a path such as pose.x[2]

Source = tuple[str, str]  # topic, field


@dataclass(frozen=True)
class Signals:
    """A recording as plain arrays: time (T,) s, inputs (T, M), outputs (T, N), mask (T, N) True for valid readings.

    A unit is "" if the log does not state it.
    """

    time: np.ndarray
    inputs: np.ndarray
    outputs: np.ndarray
    mask: np.ndarray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    hold: str = "zero_order"


def recording_groups(topics: Iterable[str]) -> list[str]:
    """Names of the recordings in a log with these topics; "" for the first, or only, one."""
    found = (re.fullmatch("/plant/(?:(.+)/)?output", topic) for topic in topics)
    return list(dict.fromkeys(match[1] or "" for match in found if match))


def series(run: Run, topic: str, fields: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """Numbers of a topic over its messages, (K,) each, NaN where missing; always with `t`, s.

    fields: names, or paths into nested messages such as "pose.x" and "data[2]"; default: all top-level numbers.
    """
    names = list(fields) if fields is not None else _numeric_fields(run, topic)
    rows = (_row(message, message.payload, names) for message in run.messages([topic]))
    table = _table(rows, len(names) + 1)
    return {"t": table[:, 0], **{name: table[:, i + 1] for i, name in enumerate(names) if name != "t"}}


def own_signals(run: Run, group: str = "") -> Signals:
    """The recording in a log of this program. Raises LogError if it has none."""
    root = f"/plant/{group}" if group else "/plant"
    source, channel = _first_channel(run, f"{root}/input"), _first_channel(run, f"{root}/output")
    if channel is None:
        raise LogError(f"{run.path}: expected messages on {root}/output, got none; map topics and fields to signals")
    time, outputs, mask = _own_table(run, channel)
    names, units = _names(channel), _units(channel)
    if source is None:
        return Signals(time, np.zeros((len(time), 0)), outputs, mask, (), names, (), units)
    clock, values, _ = _own_table(run, source)
    hold = dict(source.metadata).get("hold", "zero_order")
    inputs = held(clock, values, time)
    return Signals(time, inputs, outputs, mask, _names(source), names, _units(source), units, hold)


def mapped_signals(
    run: Run, inputs: Mapping[str, Source], outputs: Mapping[str, Source], time_field: str | None = None
) -> Signals:
    """A recording from any log: signal -> (topic, field). The first output's topic is the clock.

    Time is the log time in s since the clock's first message, or the number in `time_field`. On other topics, an input
    is held from its last message, and NaN before its first; an output is present once for each message, at the next
    time of the clock.
    """
    if not outputs:
        raise ValueError("expected at least one output, got none; map a signal to a topic and a field")
    sources = {**inputs, **outputs}
    clock_topic = next(iter(outputs.values()))[0]
    origin = next((message.log_time for message in run.messages([clock_topic])), EPOCH_NS)
    tables = {t: _mapped_table(run, t, sources, time_field, origin) for t in {t for t, _ in sources.values()}}
    clock = tables[clock_topic][0]

    def columns(part: Mapping[str, Source], once: bool) -> np.ndarray:
        found = [held(tables[topic][0], tables[topic][1][name], clock, once) for name, (topic, _) in part.items()]
        return np.array(found).reshape(len(part), len(clock)).T

    u, y = columns(inputs, once=False), columns(outputs, once=True)
    return Signals(
        clock, u, y, np.isfinite(y), tuple(inputs), tuple(outputs), ("",) * len(inputs), ("",) * len(outputs)
    )


def held(clock: np.ndarray, values: np.ndarray, time: np.ndarray, once: bool = False) -> np.ndarray:
    """Each signal's last value at or before `time`; NaN before its first. once: NaN where it repeats the one before."""
    if np.array_equal(clock, time):
        return values
    last = np.searchsorted(clock, time, side="right") - 1
    taken = values[np.maximum(last, 0)] if len(clock) else np.full((len(time), *values.shape[1:]), np.nan)
    taken[(last < 0) | (once & (np.diff(last, prepend=-1) == 0))] = np.nan
    return taken


def arrays(run: Run, name: str = "results.npz") -> dict[str, np.ndarray]:
    """The arrays of an attached .npz of limited size, without pickled objects and with consistent headers."""
    content = run.attachment(name)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [item for item in archive.infolist() if item.filename.endswith(".npy")]
            unpacked = sum(item.file_size for item in members)
            expect_unpacked(unpacked, len(content), name, MOST_ARRAY_BYTES, MOST_ARRAY_EXPANSION)
            return {item.filename.removesuffix(".npy"): _array_in(archive.read(item)) for item in members}
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
        raise LogError(f"{run.path}: {name} is not an .npz file of plain arrays ({error})") from None


def _array_in(content: bytes) -> np.ndarray:
    """The array of a .npy file. Raises ValueError if its header does not match the bytes that follow."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"expected version 1 or 2 of the format, got {version}")
    shape, _, dtype = read(file)
    claimed, there = math.prod(shape) * dtype.itemsize, len(content) - file.tell()
    if dtype.hasobject or claimed != there or any(size < 0 for size in shape):
        raise ValueError(f"expected {there} bytes of {dtype}, got a header for {claimed}")
    file.seek(0)
    return np.load(file, allow_pickle=False)


def _row(message: Message, payload: Mapping[str, Any], fields: Iterable[str]) -> list[float]:
    """Time and fields of a message."""
    t = payload.get("t")
    return [float(t) if isinstance(t, int | float) else message.t, *_numbers(payload, fields)]


def number_at(payload: Any, field: str) -> float:
    """A field by its name, or else by its path; NaN if it is not a number."""
    value = payload
    for step in [field] if field in payload else (int(i) if i else name for name, i in _STEP.findall(field)):
        try:
            value = value[step]
        except (KeyError, IndexError, TypeError):
            return float("nan")
    return float(value) if isinstance(value, int | float) else float("nan")


def _numbers(payload: Any, fields: Iterable[str]) -> list[float]:
    return [number_at(payload, field) for field in fields]


def _numeric_fields(run: Run, topic: str) -> list[str]:
    """Names of all top-level numbers in the topic's messages, in order of appearance."""
    names: dict[str, None] = {}
    for message in run.messages([topic]):
        names.update(dict.fromkeys(k for k, v in message.payload.items() if isinstance(v, int | float)))
    return [name for name in names if name != "t"]


def _table(rows: Iterable[Sequence[float]], width: int) -> np.ndarray:
    return np.fromiter(map(tuple, rows), dtype=np.dtype((np.float64, (width,))))


def _first_channel(run: Run, topic: str) -> Channel | None:
    return next((message.channel for message in run.messages([topic])), None)


def _names(channel: Channel) -> tuple[str, ...]:
    """Signals of a plant channel in order of logging: the numbers in its schema."""
    reserved = {"t", "non_finite", "wall", *topic_definition(channel.topic).fields}
    try:
        properties = orjson.loads(channel.schema_data)["properties"]
        return tuple(name for name in properties if name not in reserved)
    except (ValueError, KeyError, TypeError) as error:
        raise LogError(f"{channel.topic}: expected a schema with properties, got {error}") from None


def _units(channel: Channel) -> tuple[str, ...]:
    return tuple(channel.units.get(name, "") for name in _names(channel))


def _own_table(run: Run, channel: Channel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (T,), values (T, N) and mask (T, N) of a plant topic."""
    names = _names(channel)
    masked: list[tuple[int, int]] = []
    may_mask = "masked" in topic_definition(channel.topic).fields  # elsewhere the field is a stranger's, of any kind

    def rows() -> Iterable[Sequence[float]]:
        for row, message in enumerate(run.messages([channel.topic])):
            payload = message.payload
            if may_mask:
                masked.extend((row, names.index(name)) for name in payload.get("masked", ()) if name in names)
            yield _row(message, payload, names)

    table = _table(rows(), len(names) + 1)
    mask = np.isfinite(table[:, 1:])
    if masked:
        mask[tuple(np.array(masked).T)] = False
    return table[:, 0], table[:, 1:], mask


def _mapped_table(
    run: Run, topic: str, sources: Mapping[str, Source], time_field: str | None, origin: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times in s since `origin` (ns), or from `time_field`, and one column per signal."""
    paths = {name: path for name, (where, path) in sources.items() if where == topic}

    def rows() -> Iterable[Sequence[float]]:
        for message in run.messages([topic]):
            payload = message.payload
            t = number_at(payload, time_field) if time_field else (message.log_time - origin) * 1e-9
            yield [t, *_numbers(payload, paths.values())]

    table = _table(rows(), len(paths) + 1)
    if not len(table):
        raise LogError(f"{run.path}: expected messages on {topic}, got none; `fdi inspect {run.path}` lists the topics")
    return table[:, 0], {name: table[:, i + 1] for i, name in enumerate(paths)}
