"""Writing of an MCAP file (https://mcap.dev/spec): one exclusive writer, channels registered with their first message.

The records are the library's, but not its writer: that describes a channel in the first chunk that uses it, so that
damage there would take the messages of all later chunks of a killed run with it. Here every chunk describes its
channels and can be read alone.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from fdi_torch.logbook.exclusive_file import ExclusiveFile
from fdi_torch.logbook.scan import MAGIC
from fdi_torch.logbook.topic_definitions import Channel

PROFILE = "fdi_torch"
CHUNK_BYTES = 256 * 1024
EPOCH_NS = 946_684_800 * 10**9  # 2000-01-01T00:00:00Z: plant time 0; leaves room for negative times
_MESSAGE = struct.Struct("<BQHIQQ")
_FOOTER = struct.Struct("<BQQQ")

Timed = tuple[Channel, int, int, int, bytes]
"""Channel, log time and publish time in ns, sequence number and payload of a message."""


class _Described(NamedTuple):
    """The record of a channel, and the bytes that describe it: those of its schema and of the record."""

    channel: records.Channel
    data: bytes


class Sink:
    """An MCAP file being written. After a disk error it refuses further writes."""

    def __init__(self, path: Path, library: str, profile: str = PROFILE) -> None:
        self.path = path
        self._file = ExclusiveFile(path)
        self._crc = 0
        self._schemas: dict[tuple[str, str, bytes], records.Schema] = {}
        self._channels: dict[Channel, _Described] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[records.ChunkIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._begin_chunk()
        self._write(MAGIC + _bytes(records.Header(profile, library)))

    @property
    def written(self) -> int:
        """Bytes on disk."""
        return self._file.size

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        self.flush()
        data = _bytes(records.Metadata(name=name, metadata=dict(values)))
        self._metadata.append(records.MetadataIndex(offset=self.written, length=len(data), name=name))
        self._write(data)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        self.flush()
        properties: dict[str, Any] = {
            "name": name,
            "media_type": media_type,
            "create_time": EPOCH_NS,
            "log_time": EPOCH_NS,
        }
        record = _bytes(records.Attachment(data=data, **properties))
        self._attachments.append(
            records.AttachmentIndex(offset=self.written, length=len(record), data_size=len(data), **properties)
        )
        self._write(record)

    def message(self, channel: Channel, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        self.messages([(channel, log_time, publish_time, sequence, data)])

    def messages(self, messages: Iterable[Timed]) -> None:
        self._file.expect_alive()
        for channel, log_time, publish_time, sequence, data in messages:
            index = self._indexes.get(channel) or self._described_here(channel)
            index.records.append((log_time, self._chunk_size))
            head = _MESSAGE.pack(Opcode.MESSAGE, 22 + len(data), index.channel_id, sequence, log_time, publish_time)
            self._chunk += (head, data)
            self._chunk_size += len(head) + len(data)
            if self._chunk_size > CHUNK_BYTES:
                self.flush()

    def flush(self) -> None:
        """End the chunk and write it to disk."""
        if not self._indexes:
            return
        body, indexes = b"".join(self._chunk), self._indexes
        self._begin_chunk()
        times = [time for index in indexes.values() for time, _ in index.records]
        properties: dict[str, Any] = {
            "compression": "zstd",
            "message_start_time": min(times),
            "message_end_time": max(times),
            "uncompressed_size": len(body),
        }
        packed = zstandard.compress(body)
        start = self.written
        self._write(_bytes(records.Chunk(data=packed, uncompressed_crc=zlib.crc32(body), **properties)))
        length, offsets = self.written - start, {}
        for index in indexes.values():
            offsets[index.channel_id] = self.written
            self._write(_bytes(index))
            self._counts[index.channel_id] += len(index.records)
        self._chunks.append(
            records.ChunkIndex(
                chunk_start_offset=start,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=self.written - start - length,
                compressed_size=len(packed),
                **properties,
            )
        )

    def finish(self) -> None:
        """Close the file as a complete one."""
        try:
            self.flush()
            self._write(_bytes(records.DataEnd(self._crc)))
            start, summary, offsets = self.written, b"", b""
            for opcode, group in self._summary():
                data = b"".join(map(_bytes, group))
                if data:
                    offsets += _bytes(records.SummaryOffset(opcode, start + len(summary), len(data)))
                summary += data
            places = (start, start + len(summary))
            crc = zlib.crc32(summary + offsets + _FOOTER.pack(Opcode.FOOTER, 20, *places))
            self._write(summary + offsets + _bytes(records.Footer(*places, crc)) + MAGIC)
            self._file.sync()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _begin_chunk(self) -> None:
        self._chunk: list[bytes] = []
        self._chunk_size = 0
        self._indexes: dict[Channel, records.MessageIndex] = {}

    def _described_here(self, channel: Channel) -> records.MessageIndex:
        """The index of a channel's messages in this chunk, which describes the channel first."""
        described = self._channels.get(channel) or self._register(channel)
        self._chunk.append(described.data)
        self._chunk_size += len(described.data)
        self._indexes[channel] = records.MessageIndex(described.channel.id, [])
        return self._indexes[channel]

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._crc = zlib.crc32(data, self._crc)

    def _register(self, channel: Channel) -> _Described:
        schema = None
        if channel.schema_name:
            name, encoding, data = key = (channel.schema_name, channel.schema_encoding, channel.schema_data)
            new = records.Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
            schema = self._schemas.setdefault(key, new)
        record = records.Channel(
            id=len(self._channels) + 1,
            topic=channel.topic,
            message_encoding=channel.encoding,
            metadata=dict(channel.metadata),
            schema_id=schema.id if schema else 0,
        )
        self._channels[channel] = _Described(record, b"".join(_bytes(each) for each in (schema, record) if each))
        return self._channels[channel]

    def _summary(self) -> list[tuple[Opcode, Sequence[Any]]]:
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, [described.channel for described in self._channels.values()]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]


def _bytes(record: Any) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def log_time_of(t: float) -> int:
    """Log time, ns, of plant time in s."""
    return EPOCH_NS + round(t * 1e9)
