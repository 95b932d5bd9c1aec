"""The contents of an MCAP file, collected during writing for the summary at its end."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from fdi_torch.logbook.channel import Channel
from fdi_torch.logbook.chunk import Described
from fdi_torch.logbook.scan import MAGIC

_FOOTER = struct.Struct("<BQQQ")


class Contents:
    """Channels in order of their first messages; chunks, attachments and metadata in order of the file."""

    def __init__(self) -> None:
        self.chunks: list[records.ChunkIndex] = []
        self.metadata: list[records.MetadataIndex] = []
        self.attachments: list[records.AttachmentIndex] = []
        self._schemas: dict[tuple[str, str, bytes], records.Schema] = {}
        self._channels: dict[Channel, Described] = {}
        self._counts: dict[int, int] = {}

    def described(self, channel: Channel) -> Described:
        """The channel's records in this file, with its number."""
        return self._channels.get(channel) or self._register(channel)

    def chunk(self, index: records.ChunkIndex, messages: Mapping[int, int]) -> None:
        """Add a chunk with its number of messages by channel."""
        self.chunks.append(index)
        for number, count in messages.items():
            self._counts[number] = self._counts.get(number, 0) + count

    def ending(self, size: int, crc: int) -> bytes:
        """Everything after data of that size and CRC: end of data, summary, summary offsets, footer."""
        end_of_data = record_bytes(records.DataEnd(crc))
        start = size + len(end_of_data)
        summary, offsets = b"", b""
        for opcode, group in self._summary():
            data = b"".join(map(record_bytes, group))
            if data:
                offsets += record_bytes(records.SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        places = (start, start + len(summary))
        footer = _FOOTER.pack(Opcode.FOOTER, 20, *places)
        footer_crc = zlib.crc32(summary + offsets + footer)
        return end_of_data + summary + offsets + record_bytes(records.Footer(*places, footer_crc)) + MAGIC

    def _register(self, channel: Channel) -> Described:
        schema = None
        if channel.schema_name:
            key = (channel.schema_name, channel.schema_encoding, channel.schema_data)
            number = len(self._schemas) + 1
            schema = self._schemas.setdefault(
                key, records.Schema(number, channel.schema_data, channel.schema_encoding, channel.schema_name)
            )
        record = records.Channel(
            id=len(self._channels) + 1,
            topic=channel.topic,
            message_encoding=channel.encoding,
            metadata=dict(channel.metadata),
            schema_id=schema.id if schema else 0,
        )
        is_signal = channel.topic.startswith("/plant/") and channel.topic.endswith(("/input", "/output"))
        self._channels[channel] = Described(schema, record, is_signal)
        return self._channels[channel]

    def _summary(self) -> list[tuple[Opcode, Sequence[Any]]]:
        chunks = self.chunks
        statistics = records.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(chunks),
            message_count=sum(self._counts.values()),
            message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
            metadata_count=len(self.metadata),
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, [described.channel for described in self._channels.values()]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, chunks),
            (Opcode.ATTACHMENT_INDEX, self.attachments),
            (Opcode.METADATA_INDEX, self.metadata),
        ]


def metadata_bytes(name: str, values: Mapping[str, str]) -> bytes:
    """A metadata record, built ten times faster than by the library; a run starts with a few hundred values."""
    pairs = b"".join([_text(text) for pair in values.items() for text in pair])
    body = _text(name) + struct.pack("<I", len(pairs)) + pairs
    return struct.pack("<BQ", Opcode.METADATA, len(body)) + body


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def record_bytes(record: Any) -> bytes:
    """The bytes of an MCAP record."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
