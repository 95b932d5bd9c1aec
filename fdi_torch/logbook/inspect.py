"""Inspection of a log: its contents and its health, as data."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics

from fdi_torch.logbook.reader import Attachment, Message, Run, read_run
from fdi_torch.logbook.scan import Damage, Frame, body_of, stream_of

PREFIX = "fdi_torch."


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
    advice: str = field(default="")

    @property
    def messages(self) -> int:
        return sum(info.messages for info in self.topics.values())


def inspect_log(path: str | Path) -> Inspection:
    """Read and check a whole log of this or another program. Raises LogError if it is not an MCAP file."""
    run = read_run(path, salvage=True)
    topics = _topics(run)
    about = {name.removeprefix(PREFIX): values for name, values in run.metadata.items() if name.startswith(PREFIX)}
    others = {name: values for name, values in run.metadata.items() if not name.startswith(PREFIX)}
    health = check_health(run, topics)
    advice = run.advice
    if not health.sound and not advice:
        advice = f"{run.path}: the file is damaged; `fdi recover {run.path}` saves what can be read"
    return Inspection(
        run.path, len(run.data), run.ours, run.library, about, others, topics, run.attachments, health, advice
    )


def check_health(run: Run, topics: dict[str, TopicInfo]) -> Health:
    """Check CRCs, indices and completeness; `topics` counts what is actually in `run`, which was opened for salvage."""
    problems = [*_ending(run), *(f"bytes {gap.start} to {gap.end}: {gap.reason}" for gap in run.damages)]
    if run.ended:
        problems += [*_data_crc(run), *_summary(run, sum(info.messages for info in topics.values()))]
    chunks = sum(isinstance(part, Frame) and part.opcode == Opcode.CHUNK for part in run.parts)
    return Health(run.ended, chunks, tuple(run.damages), tuple(problems))


def _topics(run: Run) -> dict[str, TopicInfo]:
    topics: dict[str, TopicInfo] = {}
    for message in run.messages():
        if message.topic not in topics:
            channel = message.channel
            topics[message.topic] = TopicInfo(channel.topic, channel.schema_name, channel.encoding, channel.units)
        topics[message.topic].count(message)
    return topics


def _ending(run: Run) -> Iterator[str]:
    if not run.ended:
        yield "the file has no end: its writer was stopped, or the file was cut"
    elif run.ours and "fdi_torch.status" not in run.metadata and "fdi_torch.recovery" not in run.metadata:
        yield "the run does not say how it ended"


def _data_crc(run: Run) -> Iterator[str]:
    """Check the CRC of all records before the end of data."""
    for part in _frames(run, Opcode.DATA_END):
        (crc,) = struct.unpack("<I", body_of(run.data, part))
        if crc and zlib.crc32(run.data[: part.start]) != crc:
            yield "the CRC over the data differs"


def _summary(run: Run, messages: int) -> Iterator[str]:
    """Check the counts and positions in the summary against the file."""
    for part in _frames(run, Opcode.STATISTICS):
        counted = Statistics.read(stream_of(body_of(run.data, part))).message_count
        if counted != messages:
            yield f"the summary counts {counted} messages, the file holds {messages}"
    indexed = [ChunkIndex.read(stream_of(body_of(run.data, part))) for part in _frames(run, Opcode.CHUNK_INDEX)]
    places = {(index.chunk_start_offset, index.chunk_start_offset + index.chunk_length) for index in indexed}
    chunks = {(part.start, part.end) for part in _frames(run, Opcode.CHUNK)}
    if indexed and places != chunks:
        yield f"the index names {len(places)} chunks, {len(places & chunks)} of the file's {len(chunks)} among them"


def _frames(run: Run, opcode: Opcode) -> Iterator[Frame]:
    return (part for part in run.parts if isinstance(part, Frame) and part.opcode == opcode)
