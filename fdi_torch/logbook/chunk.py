"""A chunk of an MCAP file while it is filled: its records, and the positions of each channel's messages."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

_MESSAGE = struct.Struct("<BQHIQQ")
_ENTRY = struct.Struct("<QQ")
_INDEX = struct.Struct("<BQHI")
_CHUNK = struct.Struct("<BQQQQII")
# Level 1 with longer matches and a smaller table, which stays in the cache: the same size in two thirds of the time.
_ZSTD = zstandard.ZstdCompressionParameters.from_level(1, window_log=18, hash_log=13, min_match=7)
Packer = zstandard.ZstdCompressor
Span = tuple[int, int]
"""First and last log time, ns."""
_NEVER = (2**64, -1)
_INDEX_HEAD = 6  # channel number and length of the list, in a message index's body


def packer() -> Packer:
    """A compressor for chunks."""
    return Packer(compression_params=_ZSTD)


@dataclass(frozen=True)
class Described:
    """A channel and its schema as MCAP records. is_signal: whether it holds inputs or outputs of a recording."""

    schema: Schema | None
    channel: Channel
    is_signal: bool = False

    @cached_property
    def records(self) -> bytes:
        """The bytes of both records."""
        builder = RecordBuilder()
        if self.schema is not None:
            self.schema.write(builder)
        self.channel.write(builder)
        return bytes(builder.end())


class Chunk:
    """A chunk that describes every channel it uses, so that it can be read without any other chunk.

    size: bytes of its records so far. cut: whether a piece of it has been written early.
    """

    def __init__(self) -> None:
        self.size = 0
        self.cut = False
        self._records: list[bytes | memoryview] = []
        self._described: dict[int, Described] = {}
        self._indexes: dict[int, bytearray] = {}  # by channel: log time and position of every message
        self._span = _NEVER
        self._given_span, self._given = _NEVER, 0
        self._given_indexes: dict[int, int] = {}  # by channel: bytes of the index that earlier pieces hold

    @property
    def messages(self) -> dict[int, int]:
        """Number of messages by channel."""
        return {number: len(index) // _ENTRY.size for number, index in self._indexes.items()}

    @property
    def waiting(self) -> bool:
        """Whether there are messages that no piece holds yet."""
        return len(self._records) > self._given

    def message(self, described: Described, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        number = described.channel.id
        index = self._indexes.get(number)
        if index is None:
            index = self._indexes[number] = bytearray()
            self._described[number] = described
            self._records.append(described.records)
            self.size += len(described.records)
        index += _ENTRY.pack(log_time, self.size)
        earliest, latest = self._span
        if not earliest <= log_time <= latest:
            self._span = min(earliest, log_time), max(latest, log_time)
        length = len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, 22 + length, number, sequence, log_time, publish_time)
        self._records += (head, data)
        self.size += 31 + length

    def describes(self, described: Described) -> bool:
        """Whether the chunk has a message of this channel already."""
        return described.channel.id in self._indexes

    def block(self, numbers: Sequence[int], log_times: np.ndarray, records: memoryview, starts: np.ndarray) -> None:
        """Append records of channels described here, in turn; starts (B, S): their positions."""
        for number, places in zip(numbers, starts.T, strict=True):
            entries = np.empty((len(places), 2), "<u8")
            entries[:, 0] = log_times
            np.add(places, self.size, out=entries[:, 1], casting="unsafe")
            self._indexes[number] += entries.data
        self._span = _both(self._span, (int(log_times.min()), int(log_times.max())))
        self._records.append(records)
        self.size += len(records)

    def piece(self, packer: Packer | None) -> bytes:
        """The records since the last piece as a separate chunk without message indexes."""
        fresh = {n: index for n, index in self._indexes.items() if len(index) > self._given_indexes.get(n, 0)}
        described = [self._described[number].records for number in fresh if number in self._given_indexes]
        data, _ = _chunk([*described, *self._records[self._given :]], self._span, packer)
        self._given, self._given_indexes = len(self._records), {n: len(index) for n, index in self._indexes.items()}
        self._given_span, self._span = _both(self._given_span, self._span), _NEVER
        self.cut = True
        return b"".join(data)

    def record(self, packer: Packer | None, start: int) -> tuple[bytes, ChunkIndex]:
        """The chunk and its message indexes as written from byte `start`, and its entry in the chunk index."""
        parts, properties = _chunk(self._records, _both(self._given_span, self._span), packer)
        length = sum(map(len, parts))
        offsets, place = {}, start + length
        for number, index in self._indexes.items():
            offsets[number] = place
            parts += (_INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX_HEAD + len(index), number, len(index)), index)
            place += _INDEX.size + len(index)
        entry = ChunkIndex(
            chunk_start_offset=start,
            chunk_length=length,
            message_index_offsets=offsets,
            message_index_length=place - start - length,
            **properties,
        )
        return b"".join(parts), entry


def _both(a: Span, b: Span) -> Span:
    return min(a[0], b[0]), max(a[1], b[1])


def _chunk(
    records: Sequence[bytes | memoryview], span: Span, packer: Packer | None
) -> tuple[list[bytes | bytearray], dict[str, Any]]:
    """A chunk record in parts, and the properties for its index entry; span: of its messages."""
    body = b"".join(records)
    packed, compression = (body, b"") if packer is None else (packer.compress(body), b"zstd")
    length = _CHUNK.size - 9 + len(compression) + 8 + len(packed)
    head = _CHUNK.pack(Opcode.CHUNK, length, *span, len(body), zlib.crc32(body), len(compression))
    properties = {
        "compression": compression.decode(),
        "compressed_size": len(packed),
        "uncompressed_size": len(body),
        "message_start_time": span[0],
        "message_end_time": span[1],
    }
    return [head, compression, struct.pack("<Q", len(packed)), packed], properties
