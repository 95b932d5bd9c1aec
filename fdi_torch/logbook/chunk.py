"""A chunk of an MCAP file being filled: records one after the other, and where each channel's messages stand."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema
from mcap.records import Chunk as ChunkRecord

_MESSAGE = struct.Struct("<BQHIQQ")
_INDEX = struct.Struct("<BQHI")
_LEVEL = 1  # of zstd: on samples and states it packs as tightly as its usual 3, in half the time or less
_INDEX_HEAD = 6  # channel number and length of the list, in a message index's body


@dataclass(frozen=True)
class Described:
    """A channel and its schema as records of the format; whether it carries a recording's inputs or outputs."""

    schema: Schema | None
    channel: Channel
    is_signal: bool = False


class Chunk:
    """Every channel is described in each chunk that uses it, so that no chunk needs another one to be read.

    size: bytes of its records so far. A message costs two entries of a list until the chunk is written.
    """

    def __init__(self) -> None:
        self.size = 0
        self._records: list[bytes] = []
        self._indexes: dict[int, list[int]] = {}

    @property
    def messages(self) -> dict[int, int]:
        """How many messages each channel has here."""
        return {number: len(index) // 2 for number, index in self._indexes.items()}

    def message(self, told: Described, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        number = told.channel.id
        index = self._indexes.get(number)
        if index is None:
            index = self._indexes[number] = []
            self._describe(told)
        index += (log_time, self.size)
        length = len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, 22 + length, number, sequence, log_time, publish_time)
        self._records += (head, data)
        self.size += 31 + length

    def record(self, compress: bool, start: int) -> tuple[bytes, ChunkIndex]:
        """The chunk and its message indexes as they stand in the file from byte `start`, and the entry about them."""
        body = b"".join(self._records)
        packed = zstandard.compress(body, _LEVEL) if compress else body
        compression = "zstd" if compress else ""
        times = [time for index in self._indexes.values() for time in (min(index[::2]), max(index[::2]))]
        record = RecordBuilder()
        ChunkRecord(
            compression=compression,
            data=packed,
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=zlib.crc32(body),
            uncompressed_size=len(body),
        ).write(record)
        chunk = record.end()
        offsets, indexes, place = {}, [], start + len(chunk)
        for number, index in self._indexes.items():
            offsets[number] = place
            size = 8 * len(index)
            indexes.append(_INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX_HEAD + size, number, size))
            indexes.append(struct.pack(f"<{len(index)}Q", *index))
            place += _INDEX.size + size
        about = ChunkIndex(
            chunk_start_offset=start,
            chunk_length=len(chunk),
            compression=compression,
            compressed_size=len(packed),
            uncompressed_size=len(body),
            message_start_time=min(times),
            message_end_time=max(times),
            message_index_offsets=offsets,
            message_index_length=place - start - len(chunk),
        )
        return b"".join((chunk, *indexes)), about

    def _describe(self, told: Described) -> None:
        record = RecordBuilder()
        if told.schema is not None:
            told.schema.write(record)
        told.channel.write(record)
        self._records.append(record.end())
        self.size += len(self._records[-1])
