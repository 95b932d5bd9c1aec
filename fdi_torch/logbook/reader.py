"""Reading of a log: its records, messages and arrays. The file is untrusted input.

An incomplete file (`.partial`, torn by a crash) can be opened too; `advice` then states what to do. Damage in the
middle raises LogError when it is reached, unless `salvage` is set.
"""

from __future__ import annotations

import math
import mmap
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import orjson
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel as ChannelRecord
from mcap.records import Header, Metadata, Schema

from fdi_torch.disk import named_errors
from fdi_torch.logbook import scan
from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.payload import decode
from fdi_torch.logbook.schemas import conforming
from fdi_torch.logbook.sink import EPOCH_NS
from fdi_torch.logbook.topic_definitions import Channel
from fdi_torch.untrusted_input import MOST_EXPANSION, MOST_UNPACKED

AT_BOUNDS, RANGES = "at_bounds.", "ranges."  # before the parameters in the result

# Outside chunks these records have no CRC. Logs of this program have none there; one found there is a damaged record.
_LOOSE = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
_DESCRIBING: dict[int, type[Schema | ChannelRecord]] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: ChannelRecord}
_MESSAGE = struct.Struct("<HIQQ")


@dataclass(frozen=True, slots=True)
class Message:
    """One message; times in ns, `t` in s of plant time."""

    channel: Channel
    sequence: int
    log_time: int
    publish_time: int
    data: bytes

    @property
    def topic(self) -> str:
        return self.channel.topic

    @property
    def payload(self) -> dict[str, Any]:
        """Its fields, restricted to the types of its topic. Raises LogError if it is not a JSON object."""
        if self.channel.encoding != "json":
            raise LogError(f"{self.topic}: messages in {self.channel.encoding}, only json can be read")
        try:
            return conforming(self.topic, self.channel.schema_name, decode(self.data))
        except ValueError as error:
            raise LogError(f"{self.topic}: a message is not a JSON object ({error})") from None

    @property
    def t(self) -> float:
        """Plant time, s; for logs of other programs, the log time since 2000."""
        return (self.log_time - EPOCH_NS) * 1e-9


@dataclass(frozen=True)
class Attachment:
    """A file inside the log. size in bytes; frame: its position."""

    name: str
    media_type: str
    size: int
    frame: scan.Frame = field(repr=False)


class Run:
    """An opened log. metadata: record name -> texts. attachments by name. damages: unreadable parts."""

    def __init__(self, path: str | Path, salvage: bool = False) -> None:
        self.path = Path(path)
        if not self.path.exists() and (partial := Path(f"{path}.partial")).exists():
            self.path = partial  # its run lasts, or was killed
        self.salvage = salvage
        self.profile = self.library = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, Attachment] = {}
        self.damages: list[scan.Damage] = []
        self._allowed = 0  # bytes that further chunks may still expand to
        self.data = map_file(self.path)
        self.parts = list(scan.frames(self.data))
        self.ended = scan.ends_whole(self.data)
        self.complete = self.ended and not any(isinstance(part, scan.Damage) for part in self.parts)
        if self.data[:8] != scan.MAGIC and not any(isinstance(part, scan.Frame) for part in self.parts):
            raise LogError(f"{self.path}: expected an MCAP file, got something else; check the path")
        self._read_head()

    def __repr__(self) -> str:
        """What was run, when, and how it ended."""
        run, status = self.about("run"), self.about("status")
        started, ended = run.get("started", "at an unknown time")[:19], status.get("status", "unfinished")
        return f"{self.path}: {run.get('kind', 'a log of another program')}, started {started}, {ended}"

    def about(self, record: str) -> dict[str, str]:
        """A metadata record of this program, such as "status"; empty if the log has none."""
        return self.metadata.get(f"fdi_torch.{record}", {})

    @property
    def at_bounds(self) -> dict[str, str]:
        """The end of its range, 'low' or 'high', of each parameter whose estimate lies there."""
        ends = self.about("result").items()
        return {key.removeprefix(AT_BOUNDS): end for key, end in ends if key.startswith(AT_BOUNDS)}

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of each parameter, SI; an older log has none."""
        return ranges_of(self.about("result"))

    @property
    def ours(self) -> bool:
        """Whether this program wrote the log."""
        return self.profile == "fdi_torch" or "fdi_torch.run" in self.metadata

    @property
    def advice(self) -> str:
        """Advice on an incomplete or damaged file; empty for a complete one."""
        if self.complete:
            return ""
        return f"{self.path}: the file is not whole; `fdi recover {self.path}` saves what can be read"

    @property
    def config_text(self) -> str:
        """The configuration exactly as given; empty if there is none."""
        return self.attachment("config.yaml").decode() if "config.yaml" in self.attachments else ""

    def attachment(self, name: str) -> bytes:
        if name not in self.attachments:
            known = ", ".join(self.attachments) or "(none)"
            raise LogError(f"{self.path}: expected one of the attachments {known}, got {name}")
        return self.attachment_at(self.attachments[name].frame)[2]

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Messages in order of writing, of the given topics or of all."""
        for item in self.walk():
            if isinstance(item, Message) and (topics is None or item.topic in topics):
                yield item

    def walk(self) -> Iterator[Message | scan.Frame]:
        """Messages, and the frames of metadata and attachments, in order of the file."""
        self.damages = [part for part in self.parts if isinstance(part, scan.Damage)]
        directory = Directory(self._summary_records())
        self._allowed = max(MOST_UNPACKED, MOST_EXPANSION * len(self.data))
        for place, part in enumerate(self.parts):
            if isinstance(part, scan.Damage):
                if place < len(self.parts) - 1 and not self.salvage:
                    raise self._damaged(part)
            elif part.opcode == Opcode.CHUNK or (part.opcode in _LOOSE and not self.ours):
                yield from self._part_messages(part, directory)
            elif part.opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
                yield part

    def metadata_at(self, part: scan.Frame) -> tuple[str, dict[str, str]]:
        record = Metadata.read(scan.stream_of(scan.body_of(self.data, part)))
        return record.name, record.metadata

    def attachment_at(self, part: scan.Frame) -> tuple[str, str, bytes]:
        """Name, media type and bytes."""
        record = AttachmentRecord.read(scan.stream_of(scan.body_of(self.data, part)))
        return record.name, record.media_type, bytes(record.data)

    def _part_messages(self, part: scan.Frame, directory: Directory) -> list[Message]:
        """Messages of a chunk. The total expansion of compressed chunks is limited relative to the file's size."""
        try:
            cap = min(scan.MAX_CHUNK_BYTES, self._allowed)
            messages = directory.open(self.data, part, cap, require_crc=self.ours)
            self._allowed -= scan.unpacked_size(self.data, part)
            return messages
        except scan.ChunkError as error:
            damage = scan.Damage(part.start, part.end, str(error))
            self.damages.append(damage)
            if not self.salvage:
                raise self._damaged(damage) from None
            return []

    def _summary_records(self) -> Iterator[Schema | ChannelRecord]:
        """Schemas and channels of the summary, if its CRC is valid; they replace those of a lost first chunk."""
        if not self.ended:
            return
        start, _, crc = struct.unpack_from("<QQI", self.data, len(self.data) - 28)
        if not 0 < start < len(self.data) - 37 or zlib.crc32(self.data[start : len(self.data) - 12]) != crc:
            return
        for part in self.parts:
            if isinstance(part, scan.Frame) and part.start >= start and part.opcode in _DESCRIBING:
                yield _DESCRIBING[part.opcode].read(scan.stream_of(scan.body_of(self.data, part)))

    def _read_head(self) -> None:
        """Read header, metadata and the list of attachments."""
        for part in self.parts:
            if isinstance(part, scan.Damage):
                self.damages.append(part)
            elif part.opcode == Opcode.METADATA:
                name, values = self.metadata_at(part)
                self.metadata[name] = values
            elif part.opcode == Opcode.ATTACHMENT:
                name, media_type, content = self.attachment_at(part)
                self.attachments[name] = Attachment(name, media_type, len(content), part)
            elif part.opcode == Opcode.HEADER:
                header = Header.read(scan.stream_of(scan.body_of(self.data, part)))
                self.profile, self.library = header.profile, header.library

    def _damaged(self, damage: scan.Damage) -> LogError:
        return LogError(
            f"{self.path}: bytes {damage.start} to {damage.end} are damaged ({damage.reason}); "
            f"`fdi recover {self.path}` saves the rest"
        )


def read_run(path: str | Path, salvage: bool = False) -> Run:
    """Open a log of this or another program. Raises LogError if it is not an MCAP file."""
    return Run(path, salvage)


class Directory:
    """Channels by number, collected from the records that define them."""

    def __init__(self, summary: Iterable[Schema | ChannelRecord] = ()) -> None:
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        for record in summary:
            self.learn(record)

    def learn(self, record: Schema | ChannelRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
            return
        schema = self._schemas.get(record.schema_id) or Schema(0, b"", "", "")
        named = (schema.name, schema.encoding, bytes(schema.data))
        pairs = tuple(record.metadata.items())
        learnt = Channel(record.topic, record.message_encoding, *named, pairs)
        if self._channels.get(record.id) != learnt:  # keeping one object per channel speeds up lookups
            self._channels[record.id] = learnt

    def open(
        self,
        data: scan.Buffer,
        part: scan.Frame,
        max_chunk_bytes: int = scan.MAX_CHUNK_BYTES,
        require_crc: bool = False,
    ) -> list[Message]:
        """All messages of a chunk, read completely or not at all, or of a record outside chunks. Raises ChunkError."""
        if part.opcode == Opcode.CHUNK:
            body = scan.chunk_body(data, part, max_chunk_bytes, require_crc)
        else:
            body = bytes(data[part.start : part.end])
        messages = []
        try:
            for opcode, record in scan.chunk_records(body):
                if opcode == Opcode.MESSAGE:
                    messages.append(self._message(record))
                elif opcode in _DESCRIBING:
                    self.learn(_DESCRIBING[opcode].read(scan.stream_of(record)))
        except (struct.error, UnicodeDecodeError, McapError) as error:
            raise scan.ChunkError(f"chunk with a record that does not parse ({error})") from error
        return messages

    def _message(self, record: bytes) -> Message:
        number, sequence, log_time, publish_time = _MESSAGE.unpack_from(record)
        channel = self._channels.get(number)
        if channel is None:
            raise scan.ChunkError(f"message on channel {number}, which nothing describes")
        return Message(channel, sequence, log_time, publish_time, record[_MESSAGE.size :])


def map_file(path: Path) -> Any:
    """The file mapped into memory. Raises LogError if it is empty or cannot be opened."""
    with named_errors(path, LogError), open(path, "rb") as file:
        try:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError:
            raise LogError(f"{path}: the file is empty; the run was killed before it wrote anything") from None


def ranges_of(result: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """The range of each parameter in a result; a missing or unreadable end is infinite."""
    ranges = {}
    for key, text in result.items():
        if key.startswith(RANGES):
            with suppress(ValueError, TypeError):
                low, high = orjson.loads(text)
                ends = (-math.inf if low is None else float(low), math.inf if high is None else float(high))
                ranges[key.removeprefix(RANGES)] = ends
    return ranges
