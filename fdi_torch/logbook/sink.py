"""Writing of an MCAP file: one exclusive writer, channels registered with their first message.

A chunk ends when it exceeds 256 KiB, before a metadata record or an attachment, and after a long run of signals: files
with equal contents are byte-identical. What `cut` writes earlier is on disk in pieces, each a small chunk; from the
first piece on, the final file's tail is buffered, and replaces the pieces at the end. The records follow
https://mcap.dev/spec. Chunks are assembled here because a run may have a million messages, for which the library is too
slow.
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap import records

from fdi_torch.logbook.channel import Channel
from fdi_torch.logbook.chunk import Chunk, Described, packer
from fdi_torch.logbook.contents import Contents, metadata_bytes, record_bytes
from fdi_torch.logbook.errors import LogError, log_error
from fdi_torch.logbook.exclusive_file import ExclusiveFile
from fdi_torch.logbook.sample_block import Block, Timed
from fdi_torch.logbook.scan import MAGIC

PROFILE = "fdi_torch"
CHUNK_BYTES = 256 * 1024
EPOCH_NS = 946_684_800 * 10**9  # 2000-01-01T00:00:00Z: plant time 0; leaves room for negative times
STRETCH = 1000
"""A run of at least this many messages of signals, as of a recording, ends its chunk."""
IN_MEMORY = 4 << 20
"""Size beyond which the buffer of a file's tail is an unnamed file, which disappears with its process."""
_PIECE = 1 << 20


class Sink:
    """An MCAP file being written. After a disk error it refuses further writes."""

    def __init__(self, path: Path, library: str, profile: str = PROFILE, compress: bool = True) -> None:
        self.path = path
        self._file = ExclusiveFile(path)
        self._packer = packer() if compress else None
        self._contents = Contents()
        self._chunk = Chunk()
        self._size = self._crc = 0  # of the final file
        self._tail: TailBuffer | None = None
        self._signals = 0
        self._write(MAGIC)
        self._write(record_bytes(records.Header(profile, library)))

    @property
    def written(self) -> int:
        """Bytes on disk."""
        return self._file.size

    @property
    def waiting(self) -> bool:
        """Whether there is a message that is not on disk yet."""
        return self._chunk.waiting

    @property
    def in_pieces(self) -> bool:
        """Whether the file on disk differs from the final file."""
        return self._chunk.cut or self._tail is not None

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        self.flush()
        data = metadata_bytes(name, values)
        self._contents.metadata.append(records.MetadataIndex(offset=self._size, length=len(data), name=name))
        self._write(data)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        self.flush()
        properties: dict[str, Any] = {
            "name": name,
            "media_type": media_type,
            "create_time": EPOCH_NS,
            "log_time": EPOCH_NS,
        }
        record = record_bytes(records.Attachment(data=data, **properties))
        self._contents.attachments.append(
            records.AttachmentIndex(offset=self._size, length=len(record), data_size=len(data), **properties)
        )
        self._write(record)

    def message(self, channel: Channel, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        self.messages([(channel, log_time, publish_time, sequence, data)])

    def messages(self, messages: Iterable[Timed]) -> None:
        self._file.expect_alive()
        last_channel, described = None, None
        for channel, log_time, publish_time, sequence, data in messages:
            if described is None or channel is not last_channel:
                last_channel, described = channel, self._contents.described(channel)
            if described.is_signal:
                self._signals += 1
            elif self._signals:
                self._end_of_signals()
            self._chunk.message(described, log_time, publish_time, sequence, data)
            if self._chunk.size > CHUNK_BYTES:
                self.flush()

    def block(self, block: Block, first: int = 0, end: int | None = None) -> None:
        """Write the samples first..end of a block, with the same bytes as single messages."""
        end = len(block.ends) if end is None else end
        described = [self._contents.described(channel) for channel in block.channels]
        block.number([channel.channel.id for channel in described])
        same_kind = len({channel.is_signal for channel in described}) == 1
        while first < end:
            # The first sample of a chunk brings the descriptions of its channels.
            self.messages(block.messages(first, first + 1))
            first += 1
            if same_kind and all(map(self._chunk.describes, described)):
                first = self._take(block, first, end, described)

    def _take(self, block: Block, first: int, end: int, described: Sequence[Described]) -> int:
        """Write as many whole samples of a block as fit into the chunk; returns the next sample."""
        ends = block.ends
        start = int(ends[first - 1, -1])
        last = min(end, int(np.searchsorted(ends[:, -1], start + CHUNK_BYTES - self._chunk.size, "right")))
        if last <= first:
            return first
        if described[0].is_signal:
            self._signals += (last - first) * len(described)
        starts = np.append(start, ends[first:last].ravel()[:-1]).reshape(last - first, -1) - start
        records = block.data[start : ends[last - 1, -1]].data
        self._chunk.block([channel.channel.id for channel in described], block.log_times[first:last], records, starts)
        return last

    def _end_of_signals(self) -> None:
        long, self._signals = self._signals >= STRETCH, 0
        if long:
            self.flush()

    def cut(self) -> None:
        """Write waiting messages to disk, although their chunk is not full."""
        if self._chunk.waiting:
            self._file.write(self._chunk.piece(self._packer))

    def flush(self) -> None:
        """End the chunk."""
        chunk = self._chunk
        if not chunk.size:
            return
        if chunk.cut:
            self.cut()
            self._tail = self._tail or TailBuffer(self.path, self._size)
        data, index = chunk.record(self._packer, self._size)
        self._chunk = Chunk()
        self._contents.chunk(index, chunk.messages)
        self._write(data, in_pieces=chunk.cut)

    def finish(self) -> Path:
        """Close the file as a complete one; returns its path, which is beside the given one if the file was in
        pieces.
        """
        try:
            self.flush()
            ending = self._contents.ending(self._size, self._crc)
            if self._tail is None:
                self._file.write(ending)
                self._file.sync()
                return self.path
            return self._whole(self._tail, ending)
        finally:
            self._file.close()
            self._drop()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.close()
        self._drop()

    def _drop(self) -> None:
        if self._tail is not None:
            self._tail.close()

    def _whole(self, tail: TailBuffer, ending: bytes) -> Path:
        """Write a copy without pieces; if there is no room for it, replace the pieces in the file itself."""
        target = self.path.with_name(self.path.name + ".joined")
        try:
            other = ExclusiveFile(target)
            try:
                with self.path.open("rb") as file:
                    other.copy(file, 0, tail.start)
                _end(other, tail, ending)
            finally:
                other.close()
        except LogError:
            target.unlink(missing_ok=True)
            self._file.go_back(tail.start)
            _end(self._file, tail, ending)
            return self.path
        return target

    def _write(self, data: bytes, in_pieces: bool = False) -> None:
        """Write bytes of the data section, with its CRC; in_pieces: they are on disk already, in pieces."""
        if not in_pieces:
            self._file.write(data)
        if self._tail is not None:
            try:
                self._tail.write(data)
            except LogError as error:
                self._file.dead = error
                raise
        self._size += len(data)
        self._crc = zlib.crc32(data, self._crc)


class TailBuffer:
    """Buffer for the bytes after the first `start` of the final file at `path`. Raises LogError if the disk is full."""

    def __init__(self, path: Path, start: int) -> None:
        self.path, self.start = path, start
        self._bytes = tempfile.SpooledTemporaryFile(IN_MEMORY, dir=str(path.parent))  # noqa: SIM115

    def write(self, data: bytes) -> None:
        try:
            self._bytes.write(data)
        except OSError as error:
            raise log_error(self.path, error) from error

    def pieces(self) -> Iterator[bytes]:
        """All bytes, in pieces."""
        self._bytes.seek(0)
        while data := self._bytes.read(_PIECE):
            yield data

    def close(self) -> None:
        self._bytes.close()


def _end(stream: ExclusiveFile, tail: TailBuffer, ending: bytes) -> None:
    for piece in tail.pieces():
        stream.write(piece)
    stream.write(ending)
    stream.sync()


def log_time_of(t: float) -> int:
    """Log time, ns, of plant time in s."""
    return EPOCH_NS + round(t * 1e9)
