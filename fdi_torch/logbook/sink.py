"""The way into an MCAP file: one exclusive writer, channels registered at their first message, clear errors.

A chunk ends where it exceeds 256 KiB, before a metadata record or an attachment, and after a long stretch of signals:
files with equal contents are byte-identical. A chunk that `cut` ends is another matter: `Mark` remembers where the
first one begins, so that only what follows is written again. The records are those of https://mcap.dev/spec; chunks
are put together here, because a run may have a million messages and the library takes its time over each.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from fdi_torch.logbook.block import Block, Timed
from fdi_torch.logbook.channel import Channel
from fdi_torch.logbook.chunk import Chunk, Described
from fdi_torch.logbook.scan import MAGIC
from fdi_torch.logbook.stream import Stream

PROFILE = "fdi_torch"
CHUNK_BYTES = 256 * 1024
EPOCH_NS = 946_684_800 * 10**9  # 2000-01-01T00:00:00Z: plant time 0; leaves room for negative times
STRETCH = 1000
"""So many messages of signals in a row, a recording, end with a chunk."""
TAIL_BYTES = 4 << 20
"""So much on disk is still kept in memory after the mark, to be written again without being read."""
_FOOTER = struct.Struct("<BQQQ")

Tail = list[tuple[str, tuple[Any, ...]]]
"""What came since the mark: methods of the sink and what they were given."""


@dataclass(frozen=True)
class Mark:
    """A place between two chunks, and what the file had come to there."""

    size: int
    crc: int
    signals: int
    chunks: int
    metadata: int
    attachments: int
    counts: Mapping[int, int]


class Sink:
    """An MCAP file being written. After an error of the disk it is dead and refuses further writes.

    mark: where the first chunk begins that was cut. tail: what came since then; None where that was much.
    """

    def __init__(self, path: Path, library: str, profile: str = PROFILE, compress: bool = True) -> None:
        self._stream = Stream(path)
        self.path = path
        self._compress = compress
        self._schemas: dict[tuple[str, str, bytes], records.Schema] = {}
        self._channels: dict[Channel, Described] = {}
        self._chunk = Chunk()
        self._counts: dict[int, int] = {}
        self._chunks: list[records.ChunkIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._crc = 0
        self._signals = 0
        self._perhaps: Mark | None = None
        self.mark: Mark | None = None
        self.tail: Tail | None = []
        self._head = (library, profile)
        self._write(MAGIC)
        self._write(_bytes(records.Header(profile, library)))

    def again(self, target: Path) -> Sink:
        """A new file with all up to the mark, to which the rest is to be written again."""
        assert self.mark is not None
        other = Sink(target, *self._head, self._compress)
        with self.path.open("rb") as file:
            other._stream.copy(file, other.size, self.mark.size)
        other._schemas, other._channels = dict(self._schemas), dict(self._channels)
        other._crc, other._signals, other._counts = self.mark.crc, self.mark.signals, dict(self.mark.counts)
        other._chunks = self._chunks[: self.mark.chunks]
        other._metadata = self._metadata[: self.mark.metadata]
        other._attachments = self._attachments[: self.mark.attachments]
        return other

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return self._stream.size

    @property
    def waiting(self) -> bool:
        """Is there a message that is not on disk yet?"""
        return self._chunk.size > 0

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        self.flush()
        self._keep("metadata", name, values)
        data = _bytes(records.Metadata(name=name, metadata=dict(values)))
        self._metadata.append(records.MetadataIndex(offset=self.size, length=len(data), name=name))
        self._write(data)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        self.flush()
        self._keep("attachment", name, media_type, data)
        told: dict[str, Any] = {"name": name, "media_type": media_type, "create_time": EPOCH_NS, "log_time": EPOCH_NS}
        record = _bytes(records.Attachment(data=data, **told))
        self._attachments.append(
            records.AttachmentIndex(offset=self.size, length=len(record), data_size=len(data), **told)
        )
        self._write(record)

    def message(self, channel: Channel, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        self.messages([(channel, log_time, publish_time, sequence, data)])

    def messages(self, messages: Iterable[Timed]) -> None:
        self._stream.expect_alive()
        last, told = None, None
        for channel, log_time, publish_time, sequence, data in messages:
            if told is None or channel is not last:
                last, told = channel, self._channels.get(channel) or self._register(channel)
            if told.is_signal:
                self._count_signals(1)
            elif self._signals:
                self._end_of_signals()
            self._chunk.message(told, log_time, publish_time, sequence, data)
            if self.tail is not None:
                self.tail.append(("message", (channel, log_time, publish_time, sequence, data)))
            if self._chunk.size > CHUNK_BYTES:
                self.flush()

    def block(self, block: Block, first: int = 0, end: int | None = None) -> None:
        """The messages of a block, samples first..end of it, to the same bytes as one after the other."""
        end = len(block.ends) if end is None else end
        numbered = False
        while first < end:
            # The first sample of a chunk brings the descriptions of its channels.
            self.messages(block.messages(first, first + 1))
            first += 1
            told = [self._channels[channel] for channel in block.channels]
            if not numbered:
                block.number([channel.channel.id for channel in told])
                numbered = True
            if len({channel.is_signal for channel in told}) == 1 and all(map(self._chunk.describes, told)):
                first = self._take(block, first, end, told)

    def _take(self, block: Block, first: int, end: int, told: Sequence[Described]) -> int:
        """Whole samples of a block from the first on, as many as leave the chunk room for more. The next one."""
        ends = block.ends
        start = int(ends[first - 1, -1])
        last = min(end, int(np.searchsorted(ends[:, -1], start + CHUNK_BYTES - self._chunk.size, "right")))
        if last <= first:
            return first
        if told[0].is_signal:
            self._count_signals((last - first) * len(told))
        starts = np.append(start, ends[first:last].ravel()[:-1]).reshape(last - first, -1) - start
        records = block.data[start : ends[last - 1, -1]].tobytes()
        if self.tail is not None:
            self.tail.append(("block", (block, first, last)))
        self._chunk.block([channel.channel.id for channel in told], block.log_times[first:last], records, starts)
        return last

    def _count_signals(self, more: int) -> None:
        self._signals += more
        if self._perhaps is not None:
            self.mark, self._perhaps = self.mark or self._perhaps, None

    def _end_of_signals(self) -> None:
        long, self._signals, self._perhaps = self._signals >= STRETCH, 0, None
        if long:
            self.flush()
            self._forget()

    def _keep(self, what: str, *given: Any) -> None:
        if self.tail is not None and (self.mark or self._perhaps):
            self.tail.append((what, given))

    def _forget(self) -> None:
        """What came before the mark stays as it is, and nobody needs the tail of what is too much for it."""
        if self.mark is None and self._perhaps is None:
            self.tail = []
        elif self.mark is not None and self.size - self.mark.size > TAIL_BYTES:
            self.tail = None

    def cut(self) -> None:
        """What waits goes to disk now, though its chunk is not full. Where signals end it would end anyway."""
        if self.waiting and self.mark is None:
            mark = Mark(
                self.size,
                self._crc,
                self._signals,
                len(self._chunks),
                len(self._metadata),
                len(self._attachments),
                dict(self._counts),
            )
            if self._signals >= STRETCH:
                self._perhaps = self._perhaps or mark
            else:
                self.mark = mark
        self.flush()

    def flush(self) -> None:
        """What waits goes to disk as a chunk."""
        counts = self._chunk.messages
        if not counts:
            return
        data, index = self._chunk.record(self._compress, self.size)
        self._chunk = Chunk()
        self._chunks.append(index)
        for number, count in counts.items():
            self._counts[number] = self._counts.get(number, 0) + count
        self._write(data)
        self._forget()

    def finish(self) -> None:
        """Close the file as a whole one, on disk."""
        try:
            self.flush()
            self._stream.write(_bytes(records.DataEnd(self._crc)) + self._ending())
            self._stream.sync()
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    def _register(self, channel: Channel) -> Described:
        schema = None
        if channel.schema_name:
            key = (channel.schema_name, channel.schema_encoding, channel.schema_data)
            number = len(self._schemas) + 1
            schema = self._schemas.setdefault(
                key, records.Schema(number, channel.schema_data, channel.schema_encoding, channel.schema_name)
            )
        told = records.Channel(
            id=len(self._channels) + 1,
            topic=channel.topic,
            message_encoding=channel.encoding,
            metadata=dict(channel.metadata),
            schema_id=schema.id if schema else 0,
        )
        is_signal = channel.topic.startswith("/plant/") and channel.topic.endswith(("/input", "/output"))
        self._channels[channel] = Described(schema, told, is_signal)
        return self._channels[channel]

    def _write(self, data: bytes) -> None:
        """Bytes of the data section, over which its CRC runs."""
        self._stream.write(data)
        self._crc = zlib.crc32(data, self._crc)

    def _ending(self) -> bytes:
        """All that follows the end of the data: summary, where its parts begin, and the footer."""
        start = self.size + len(_bytes(records.DataEnd(0)))
        summary, offsets = b"", b""
        for opcode, group in self._summary():
            data = b"".join(map(_bytes, group))
            if data:
                offsets += _bytes(records.SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        places = (start, start + len(summary))
        footer = _FOOTER.pack(Opcode.FOOTER, 20, *places)
        crc = zlib.crc32(summary + offsets + footer)
        return summary + offsets + _bytes(records.Footer(places[0], places[1], crc)) + MAGIC

    def _summary(self) -> list[tuple[Opcode, Sequence[Any]]]:
        chunks = self._chunks
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(chunks),
            message_count=sum(self._counts.values()),
            message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, [told.channel for told in self._channels.values()]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]


def _bytes(record: Any) -> bytes:
    """A record of the format as it stands in the file."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def log_time_of(t: float) -> int:
    """Plant time in s as log time in ns."""
    return EPOCH_NS + round(t * 1e9)
