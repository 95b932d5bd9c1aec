"""What a log holds, for people and programs: its contents and its health as data, and the export of a topic or an
attachment.
"""

from __future__ import annotations

import csv
import io
import math
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import orjson
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics

from fdi_torch.disk import named_errors
from fdi_torch.logbook.compare import AXES
from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.reader import Attachment, Message, Run, read_run
from fdi_torch.logbook.scan import Damage, Frame, body_of, stream_of
from fdi_torch.names import counted
from fdi_torch.tables import Table

_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


def export(run: Run, topic: str, form: str, stream: BinaryIO) -> int:
    """Write a topic's messages as "csv", "ndjson" or "npz" to an open binary file; returns their number.

    csv: one row per message, units in the header (`h1_m`, `Q1_m3_s`), lists as JSON. ndjson: the messages unchanged.
    npz: one array per field of numbers or text. Raises LogError if the topic has no messages.
    """
    if form not in FORMATS:
        raise ValueError(f"expected one of the formats {', '.join(FORMATS)}, got {form}")
    messages = list(run.messages([topic]))
    if not messages:
        known = ", ".join(sorted({message.topic for message in run.messages()})) or "(none)"
        raise LogError(f"{run.path}: expected one of the topics {known}, got {topic}")
    FORMATS[form](run, messages, stream)
    return len(messages)


def export_attachment(run: Run, name: str, folder: str | Path) -> Path:
    """Write an attachment into `folder`, never outside it and never over a file. Returns its path."""
    content = run.attachment(name)
    target = Path(folder) / safe_name(name)
    with named_errors(target, LogError):
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            raise LogError(f"{target}: exists already; choose another folder, or delete it")
        with target.open("xb") as file:
            file.write(content)
    return target


def safe_name(name: str) -> str:
    """A file name from the last part of `name`, with harmless characters only."""
    last = re.split(r"[/\\]", name)[-1]
    return _UNSAFE.sub("_", last).lstrip(".")[:100] or "attachment"


def _csv(_run: Run, messages: Sequence[Message], stream: BinaryIO) -> None:
    payloads, columns, units = _columns(messages)
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    table = csv.writer(text)
    table.writerow([_header(name, units.get(name, "")) for name in columns])
    table.writerows([_cell(payload.get(name)) for name in columns] for payload in payloads)
    text.detach()


def _ndjson(run: Run, messages: Sequence[Message], stream: BinaryIO) -> None:
    """The raw JSON, with its lists of non-finite numbers."""
    for message in messages:
        if message.channel.encoding != "json":
            raise LogError(f"{run.path}: {message.topic} is in {message.channel.encoding}, only json can be exported")
        try:
            stream.write(orjson.dumps(orjson.loads(message.data), option=orjson.OPT_APPEND_NEWLINE))
        except ValueError as error:
            raise LogError(f"{run.path}: a message on {message.topic} is not JSON ({error})") from None


def _npz(_run: Run, messages: Sequence[Message], stream: BinaryIO) -> None:
    payloads, columns, _ = _columns(messages)
    arrays = {name: _array([payload.get(name) for payload in payloads]) for name in columns}
    np.savez_compressed(stream, **{name: array for name, array in arrays.items() if array is not None})  # type: ignore[arg-type]


FORMATS: dict[str, Callable[[Run, Sequence[Message], BinaryIO], None]] = {"csv": _csv, "ndjson": _ndjson, "npz": _npz}


def _columns(messages: Sequence[Message]) -> tuple[list[dict[str, Any]], list[str], dict[str, str]]:
    """Payloads of the messages, their fields with `t` first, and the units of these."""
    payloads = [message.payload for message in messages]
    names = dict.fromkeys(name for payload in payloads for name in payload)
    units = {name: unit for message in messages for name, unit in message.channel.units.items()}
    return payloads, sorted(names, key=lambda name: name != "t"), units


def _header(name: str, unit: str) -> str:
    suffix = unit.replace("^", "").replace("/", "_")
    return f"{name}_{suffix}" if suffix not in ("", "1") else name


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    return value if isinstance(value, str) else orjson.dumps(value).decode()


def _array(values: list[Any]) -> np.ndarray | None:
    """Numbers, NaN where missing, or texts; None for other values."""
    if all(isinstance(value, int | float | None) for value in values):
        return np.array([np.nan if value is None else float(value) for value in values])
    if all(isinstance(value, str | None) for value in values):
        return np.array([value or "" for value in values])
    return None


PREFIX = "fdi_torch."

WITHOUT_TIME = ("/estimator/", "/estimate/final", "/gap/", "/study/")
"""Beginnings of topics whose messages have no plant time."""


@dataclass
class TopicInfo:
    """A topic's messages. first, last: plant time, s. size: bytes before compression."""

    topic: str
    schema: str
    encoding: str
    units: dict[str, str]
    messages: int = 0
    size: int = 0
    first: float = float("nan")
    last: float = float("nan")

    @property
    def span(self) -> tuple[str, str]:
        """The first and last plant time, or generation or iteration of a topic of the search; empty for others."""
        axis = AXES.get(self.topic, "")
        if not math.isfinite(self.first) or (not axis and self.topic.startswith(WITHOUT_TIME)):
            return "", ""
        first, last = (f"{axis} {end:g}" if axis else f"{end:.6g} s" for end in (self.first, self.last))
        return first, last

    def count(self, message: Message) -> None:
        self.first = message.t if self.messages == 0 else min(self.first, message.t)
        self.last = message.t if self.messages == 0 else max(self.last, message.t)
        self.messages += 1
        self.size += len(message.data)


@dataclass(frozen=True)
class Health:
    """ended: whether the file was finished. problems: one sentence each; empty if every check passed."""

    ended: bool
    chunks: int
    damages: tuple[Damage, ...]
    problems: tuple[str, ...]

    @property
    def sound(self) -> bool:
        return self.ended and not self.problems


@dataclass(frozen=True)
class Inspection:
    """about: this program's metadata by short name ("run", "config", "status", "result" ...); {} for other logs."""

    path: Path
    size: int
    ours: bool
    library: str
    about: dict[str, dict[str, str]]
    other_metadata: dict[str, dict[str, str]]
    topics: dict[str, TopicInfo]
    attachments: dict[str, Attachment]
    health: Health
    advice: str = ""

    @property
    def messages(self) -> int:
        return sum(info.messages for info in self.topics.values())

    @property
    def content(self) -> str:
        """'60 messages on 3 topics in 1 chunk, 9000 bytes'."""
        counts = f"{counted(self.messages, 'message')} on {counted(len(self.topics), 'topic')}"
        return f"{counts} in {counted(self.health.chunks, 'chunk')}, {self.size} bytes"

    def table(self) -> Table:
        """One row per topic."""
        rows = [(i.topic, i.schema, i.messages, *i.span, i.size) for i in self.topics.values()]
        return Table(("topic", "schema", "messages", "from", "to", "bytes"), rows)


def inspect_log(path: str | Path) -> Inspection:
    """Read and check a whole log of this or another program. Raises LogError if it is not an MCAP file."""
    run = read_run(path, salvage=True)
    topics: dict[str, TopicInfo] = {}
    for message in run.messages():
        if message.topic not in topics:
            channel = message.channel
            topics[message.topic] = TopicInfo(channel.topic, channel.schema_name, channel.encoding, channel.units)
        topics[message.topic].count(message)
    about = {name.removeprefix(PREFIX): values for name, values in run.metadata.items() if name.startswith(PREFIX)}
    others = {name: values for name, values in run.metadata.items() if not name.startswith(PREFIX)}
    problems = [*_ending(run), *(f"bytes {gap.start} to {gap.end}: {gap.reason}" for gap in run.damages)]
    if run.ended:
        problems += _summary(run, sum(info.messages for info in topics.values()))
    health = Health(run.ended, len(_frames(run, Opcode.CHUNK)), tuple(run.damages), tuple(problems))
    advice = run.advice
    if not health.sound and not advice:
        advice = f"{run.path}: the file is damaged; `fdi recover {run.path}` saves what can be read"
    return Inspection(
        run.path, len(run.data), run.ours, run.library, about, others, topics, run.attachments, health, advice
    )


def _ending(run: Run) -> Iterator[str]:
    if not run.ended:
        yield "the file has no end: its writer was stopped, or the file was cut"
    elif run.ours and "fdi_torch.status" not in run.metadata and "fdi_torch.recovery" not in run.metadata:
        yield "the run does not say how it ended"


def _summary(run: Run, messages: int) -> Iterator[str]:
    """Check the CRC of all records before the end of data, and the counts and positions in the summary."""
    for part in _frames(run, Opcode.DATA_END):
        (crc,) = struct.unpack("<I", body_of(run.data, part))
        if crc and zlib.crc32(run.data[: part.start]) != crc:
            yield "the CRC over the data differs"
    for part in _frames(run, Opcode.STATISTICS):
        count = Statistics.read(stream_of(body_of(run.data, part))).message_count
        if count != messages:
            yield f"the summary counts {count} messages, the file holds {messages}"
    indexed = [ChunkIndex.read(stream_of(body_of(run.data, part))) for part in _frames(run, Opcode.CHUNK_INDEX)]
    places = {(index.chunk_start_offset, index.chunk_start_offset + index.chunk_length) for index in indexed}
    chunks = {(part.start, part.end) for part in _frames(run, Opcode.CHUNK)}
    if indexed and places != chunks:
        yield f"the index names {len(places)} chunks, {len(places & chunks)} of the file's {len(chunks)} among them"


def _frames(run: Run, opcode: Opcode) -> list[Frame]:
    return [part for part in run.parts if isinstance(part, Frame) and part.opcode == opcode]
