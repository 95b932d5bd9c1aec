"""Parsing of MCAP records from bytes that may be torn, damaged or hostile.

A record is opcode (1 byte), length (8 bytes, little-endian) and body (https://mcap.dev/spec). `frames` walks the top
level; it skips from an invalid record to the next valid one and reports the gap. `chunk_records` parses a chunk, never
beyond a limit of bytes, and only with a valid CRC. Invalid bytes raise no error but `ChunkError`.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 64 * 2**20
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
# Records at which reading may resume after damage, because inner lengths validate them: chunk, chunk index, attachment,
# statistics, metadata, data end. The three high bytes of any plausible length are zero.
_ANCHORS = re.compile(rb"[\x06\x08\x09\x0b\x0c\x0f](?=.{5}\x00\x00\x00)", re.DOTALL)

_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_TEXT, _MAP, _BYTES, _LONG_BYTES, _REST = "text", "texts", "bytes", "long bytes", "the rest"
_LAYOUTS: dict[int, tuple[int | str, ...]] = {  # fields of a record; a number is that of bytes of fixed length
    Opcode.HEADER: (_TEXT, _TEXT),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, _TEXT, _TEXT, _BYTES),
    Opcode.CHANNEL: (4, _TEXT, _TEXT, _MAP),
    Opcode.MESSAGE: (22, _REST),
    Opcode.CHUNK: (28, _TEXT, _LONG_BYTES),
    Opcode.MESSAGE_INDEX: (2, _BYTES),
    Opcode.CHUNK_INDEX: (32, _BYTES, 8, _TEXT, 16),
    Opcode.ATTACHMENT: (16, _TEXT, _TEXT, _LONG_BYTES, 4),
    Opcode.STATISTICS: (42, _BYTES),
    Opcode.METADATA: (_TEXT, _MAP),
    Opcode.SUMMARY_OFFSET: (17,),
    Opcode.DATA_END: (4,),
}

Buffer = Any  # bytes or mmap


@dataclass(frozen=True)
class Frame:
    """A valid record: bytes start..end of the file, including opcode and length."""

    opcode: int
    start: int
    end: int


@dataclass(frozen=True)
class Damage:
    """Unreadable bytes start..end of the file."""

    start: int
    end: int
    reason: str


class ChunkError(ValueError):
    """A chunk that cannot be read, with the reason."""


def frames(data: Buffer, start: int | None = None) -> Iterator[Frame | Damage]:
    """Valid records in order, and the gaps between them; a gap at the end is a torn record."""
    size = len(data)
    place = (8 if data[:8] == MAGIC else 0) if start is None else start
    while place < size and data[place : place + 8] != MAGIC[: size - place]:
        end = _sound(data, place)
        if end is not None:
            yield Frame(data[place], place, end)
        else:
            end = _after_damage(data, place)
            yield Damage(place, end, "torn at the end" if end == size else "unreadable record")
        place = end


def ends_whole(data: Buffer) -> bool:
    """Whether the file ends with footer and magic, as a finished one does."""
    return len(data) > 45 and data[-8:] == MAGIC and data[-37:-28] == _HEAD.pack(Opcode.FOOTER, 20)


def unpacked_size(data: Buffer, frame: Frame) -> int:
    """Stated size of the records in a chunk, or size of a record outside chunks, bytes."""
    return (
        int(_CHUNK.unpack_from(data, frame.start + 9)[2]) if frame.opcode == Opcode.CHUNK else frame.end - frame.start
    )


def chunk_body(data: Buffer, frame: Frame, cap: int = MAX_CHUNK_BYTES, require_crc: bool = False) -> bytes:
    """The records inside a chunk. Raises ChunkError if they exceed `cap`, or have a wrong compression or CRC."""
    size, crc = _CHUNK.unpack_from(data, frame.start + 9)[2:]
    name_end = frame.start + 41 + _U32.unpack_from(data, frame.start + 37)[0]
    compression = bytes(data[frame.start + 41 : name_end])
    if size > cap:
        raise ChunkError(f"chunk of {size} bytes, more than the {cap} allowed")
    body = _decompress(compression, data[name_end + 8 : frame.end], size)
    if len(body) != size:
        raise ChunkError("chunk of another size than it states")
    if (crc or require_crc) and zlib.crc32(body) != crc:
        raise ChunkError("chunk whose CRC differs")
    return body


def chunk_records(body: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and body of each record inside a chunk. Raises ChunkError for a record that leaves its chunk."""
    place = 0
    while place < len(body):
        opcode, length = _HEAD.unpack_from(body, place) if len(body) >= place + 9 else (0, len(body))
        end = place + 9 + length
        if end > len(body):
            raise ChunkError("record that leaves its chunk")
        yield opcode, body[place + 9 : end]
        place = end


def stream_of(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def body_of(data: Buffer, frame: Frame) -> bytes:
    """The record without its opcode and length."""
    return bytes(data[frame.start + 9 : frame.end])


def _decompress(compression: bytes, data: bytes, size: int) -> bytes:
    """Decompress at most size + 1 bytes, whatever the data claim."""
    try:
        if compression == b"zstd":
            return zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(io.BytesIO(data)).read(size + 1)
        if compression == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise ChunkError(f"chunk that does not decompress ({error})") from error
    if compression:
        raise ChunkError(f"chunk in the unknown compression {compression!r}")
    return data


def _after_damage(data: Buffer, place: int) -> int:
    """Where reading resumes: after the damaged record if its length leads to a valid one, else at the next anchor."""
    end = _framed(data, place)
    if end is not None and end < len(data) and (_sound(data, end) is not None or data[end:] == MAGIC):
        return end
    sound = (match.start() for match in _ANCHORS.finditer(data, place + 1) if _sound(data, match.start()) is not None)
    return next(sound, len(data))


def _framed(data: Buffer, place: int) -> int | None:
    """End of a record by its length alone; None if it exceeds the file or has no opcode."""
    if len(data) - place < 9:
        return None
    opcode, length = _HEAD.unpack_from(data, place)
    return place + 9 + length if opcode and length <= len(data) - place - 9 else None


def _sound(data: Buffer, place: int) -> int | None:
    """End of a record whose inner lengths (for attachments also the CRC) agree, else None."""
    end = _framed(data, place)
    if end is None or data[place] not in _LAYOUTS:
        return end
    try:
        fits = _ends(_LAYOUTS[data[place]], data, place + 9, end) == end
    except (struct.error, UnicodeDecodeError):
        return None
    return end if fits and (data[place] != Opcode.ATTACHMENT or _attachment_agrees(data, place, end)) else None


def _ends(layout: Sequence[int | str], data: Buffer, place: int, end: int) -> int:
    """The position behind a record's fields, which begin at `place`; it is beyond `end` if they do not fit."""
    for field in layout:
        if isinstance(field, int):
            place += field
            continue
        if field == _REST:
            return max(place, end)
        size = _U64 if field == _LONG_BYTES else _U32
        begin = place + size.size
        place = begin + size.unpack_from(data, place)[0]
        if place > end:
            return place
        if field == _TEXT:
            bytes(data[begin:place]).decode()
        while field == _MAP and begin != place:
            begin = _ends((_TEXT, _TEXT), data, begin, place)
            if begin > place:
                return end + 1
    return place


def _attachment_agrees(data: Buffer, place: int, end: int) -> bool:
    crc = _U32.unpack_from(data, end - 4)[0]
    return crc == 0 or zlib.crc32(data[place + 9 : end - 4]) == crc
