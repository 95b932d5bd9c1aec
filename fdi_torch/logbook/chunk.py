"""A chunk of an MCAP file being filled: records one after the other, and where each channel's messages stand."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema
from mcap.records import Chunk as ChunkRecord

_MESSAGE = struct.Struct("<BQHIQQ")
_ENTRY = struct.Struct("<QQ")
_INDEX = struct.Struct("<BQHI")
# Level 1 but for longer matches and a smaller table, that stays in the cache: samples and states in two thirds of the
# time, not a byte larger.
_ZSTD = zstandard.ZstdCompressionParameters.from_level(1, window_log=18, hash_log=13, min_match=7)
_INDEX_HEAD = 6  # channel number and length of the list, in a message index's body


@dataclass(frozen=True)
class Described:
    """A channel and its schema as records of the format; whether it carries a recording's inputs or outputs."""

    schema: Schema | None
    channel: Channel
    is_signal: bool = False

    @cached_property
    def records(self) -> bytes:
        """Both as they stand in the file."""
        builder = RecordBuilder()
        if self.schema is not None:
            self.schema.write(builder)
        self.channel.write(builder)
        return bytes(builder.end())


class Chunk:
    """Every channel is described in each chunk that uses it, so that no chunk needs another one to be read.

    size: bytes of its records so far.
    """

    def __init__(self) -> None:
        self.size = 0
        self._records: list[bytes] = []
        self._indexes: dict[int, bytearray] = {}  # of each channel: log time and place of every message

    @property
    def messages(self) -> dict[int, int]:
        """How many messages each channel has here."""
        return {number: len(index) // _ENTRY.size for number, index in self._indexes.items()}

    def message(self, told: Described, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        number = told.channel.id
        index = self._indexes.get(number)
        if index is None:
            index = self._indexes[number] = bytearray()
            self._records.append(told.records)
            self.size += len(told.records)
        index += _ENTRY.pack(log_time, self.size)
        length = len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, 22 + length, number, sequence, log_time, publish_time)
        self._records += (head, data)
        self.size += 31 + length

    def describes(self, told: Described) -> bool:
        """Has this channel a message here already?"""
        return told.channel.id in self._indexes

    def block(self, numbers: Sequence[int], log_times: np.ndarray, records: bytes, starts: np.ndarray) -> None:
        """Records of messages of channels that are described here, in turn, which start at the places (B, S)."""
        for number, places in zip(numbers, starts.T, strict=True):
            self._indexes[number] += np.column_stack([log_times, self.size + places]).astype("<u8").tobytes()
        self._records.append(records)
        self.size += len(records)

    def record(self, compress: bool, start: int) -> tuple[bytes, ChunkIndex]:
        """The chunk and its message indexes as they stand in the file from byte `start`, and the entry about them."""
        body = b"".join(self._records)
        packed = zstandard.ZstdCompressor(compression_params=_ZSTD).compress(body) if compress else body
        compression = "zstd" if compress else ""
        times = np.concatenate([np.frombuffer(index, "<u8")[::2] for index in self._indexes.values()])
        earliest, latest = int(times.min()), int(times.max())
        record = RecordBuilder()
        ChunkRecord(
            compression=compression,
            data=packed,
            message_start_time=earliest,
            message_end_time=latest,
            uncompressed_crc=zlib.crc32(body),
            uncompressed_size=len(body),
        ).write(record)
        chunk = record.end()
        offsets, indexes, place = {}, [], start + len(chunk)
        for number, index in self._indexes.items():
            offsets[number] = place
            indexes.append(_INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX_HEAD + len(index), number, len(index)))
            indexes.append(bytes(index))
            place += _INDEX.size + len(index)
        about = ChunkIndex(
            chunk_start_offset=start,
            chunk_length=len(chunk),
            compression=compression,
            compressed_size=len(packed),
            uncompressed_size=len(body),
            message_start_time=earliest,
            message_end_time=latest,
            message_index_offsets=offsets,
            message_index_length=place - start - len(chunk),
        )
        return b"".join((chunk, *indexes)), about
