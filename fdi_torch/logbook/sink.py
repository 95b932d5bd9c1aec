"""The way into an MCAP file: one exclusive writer, channels registered at their first message, clear errors.

A chunk ends where it exceeds 256 KiB, before a metadata record or an attachment, and after a long stretch of signals:
files with equal contents are byte-identical. What `cut` brings to disk earlier stands there in pieces, each a small
chunk; from the first one on the file as it shall be is kept beside it, and takes its place at the end. The records are
those of https://mcap.dev/spec; chunks are put together here, because a run may have a million messages and the library
takes its time over each.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap import records

from fdi_torch.logbook.block import Block, Timed
from fdi_torch.logbook.channel import Channel
from fdi_torch.logbook.chunk import Chunk, Described, packer
from fdi_torch.logbook.contents import Contents, metadata_bytes, record_bytes
from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.rest import Rest
from fdi_torch.logbook.scan import MAGIC
from fdi_torch.logbook.stream import Stream

PROFILE = "fdi_torch"
CHUNK_BYTES = 256 * 1024
EPOCH_NS = 946_684_800 * 10**9  # 2000-01-01T00:00:00Z: plant time 0; leaves room for negative times
STRETCH = 1000
"""So many messages of signals in a row, a recording, end with a chunk."""


class Sink:
    """An MCAP file being written. After an error of the disk it is dead and refuses further writes."""

    def __init__(self, path: Path, library: str, profile: str = PROFILE, compress: bool = True) -> None:
        self.path = path
        self._stream = Stream(path)
        self._packer = packer() if compress else None
        self._contents = Contents()
        self._chunk = Chunk()
        self._size = self._crc = 0  # of the file as it shall be
        self._rest: Rest | None = None
        self._signals = 0
        self._write(MAGIC)
        self._write(record_bytes(records.Header(profile, library)))

    @property
    def written(self) -> int:
        """Bytes on disk."""
        return self._stream.size

    @property
    def waiting(self) -> bool:
        """Is there a message that is not on disk yet?"""
        return self._chunk.waiting

    @property
    def in_pieces(self) -> bool:
        """Does some of it stand on disk otherwise than it shall?"""
        return self._chunk.cut or self._rest is not None

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        self.flush()
        data = metadata_bytes(name, values)
        self._contents.metadata.append(records.MetadataIndex(offset=self._size, length=len(data), name=name))
        self._write(data)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        self.flush()
        told: dict[str, Any] = {"name": name, "media_type": media_type, "create_time": EPOCH_NS, "log_time": EPOCH_NS}
        record = record_bytes(records.Attachment(data=data, **told))
        self._contents.attachments.append(
            records.AttachmentIndex(offset=self._size, length=len(record), data_size=len(data), **told)
        )
        self._write(record)

    def message(self, channel: Channel, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        self.messages([(channel, log_time, publish_time, sequence, data)])

    def messages(self, messages: Iterable[Timed]) -> None:
        self._stream.expect_alive()
        last, told = None, None
        for channel, log_time, publish_time, sequence, data in messages:
            if told is None or channel is not last:
                last, told = channel, self._contents.described(channel)
            if told.is_signal:
                self._signals += 1
            elif self._signals:
                self._end_of_signals()
            self._chunk.message(told, log_time, publish_time, sequence, data)
            if self._chunk.size > CHUNK_BYTES:
                self.flush()

    def block(self, block: Block, first: int = 0, end: int | None = None) -> None:
        """The messages of a block, samples first..end of it, to the same bytes as one after the other."""
        end = len(block.ends) if end is None else end
        told = [self._contents.described(channel) for channel in block.channels]
        block.number([channel.channel.id for channel in told])
        alike = len({channel.is_signal for channel in told}) == 1
        while first < end:
            # The first sample of a chunk brings the descriptions of its channels.
            self.messages(block.messages(first, first + 1))
            first += 1
            if alike and all(map(self._chunk.describes, told)):
                first = self._take(block, first, end, told)

    def _take(self, block: Block, first: int, end: int, told: Sequence[Described]) -> int:
        """Whole samples of a block from the first on, as many as leave the chunk room for more. The next one."""
        ends = block.ends
        start = int(ends[first - 1, -1])
        last = min(end, int(np.searchsorted(ends[:, -1], start + CHUNK_BYTES - self._chunk.size, "right")))
        if last <= first:
            return first
        if told[0].is_signal:
            self._signals += (last - first) * len(told)
        starts = np.append(start, ends[first:last].ravel()[:-1]).reshape(last - first, -1) - start
        records = block.data[start : ends[last - 1, -1]].data
        self._chunk.block([channel.channel.id for channel in told], block.log_times[first:last], records, starts)
        return last

    def _end_of_signals(self) -> None:
        long, self._signals = self._signals >= STRETCH, 0
        if long:
            self.flush()

    def cut(self) -> None:
        """What waits goes to disk now, though its chunk is not full."""
        if self._chunk.waiting:
            self._stream.write(self._chunk.piece(self._packer))

    def flush(self) -> None:
        """The chunk ends here."""
        chunk = self._chunk
        if not chunk.size:
            return
        if chunk.cut:
            self.cut()
            self._rest = self._rest or Rest(self.path, self._size)
        data, index = chunk.record(self._packer, self._size)
        self._chunk = Chunk()
        self._contents.chunk(index, chunk.messages)
        self._write(data, in_pieces=chunk.cut)

    def finish(self) -> Path:
        """Close the file as a whole one, on disk. It stands beside its path where it was in pieces there."""
        try:
            self.flush()
            ending = self._contents.ending(self._size, self._crc)
            if self._rest is None:
                self._stream.write(ending)
                self._stream.sync()
                return self.path
            return self._whole(self._rest, ending)
        finally:
            self._stream.close()
            self._drop()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._stream.close()
        self._drop()

    def _drop(self) -> None:
        if self._rest is not None:
            self._rest.close()

    def _whole(self, rest: Rest, ending: bytes) -> Path:
        """A copy without pieces, or where there is no room for one, the file itself made so."""
        target = self.path.with_name(self.path.name + ".joined")
        try:
            other = Stream(target)
            try:
                with self.path.open("rb") as file:
                    other.copy(file, 0, rest.start)
                _end(other, rest, ending)
            finally:
                other.close()
        except LogError:
            target.unlink(missing_ok=True)
            self._stream.go_back(rest.start)
            _end(self._stream, rest, ending)
            return self.path
        return target

    def _write(self, data: bytes, in_pieces: bool = False) -> None:
        """Bytes of the data section, over which its CRC runs; in_pieces: those on disk hold them already."""
        if not in_pieces:
            self._stream.write(data)
        if self._rest is not None:
            try:
                self._rest.write(data)
            except LogError as error:
                self._stream.dead = error
                raise
        self._size += len(data)
        self._crc = zlib.crc32(data, self._crc)


def _end(stream: Stream, rest: Rest, ending: bytes) -> None:
    for piece in rest.pieces():
        stream.write(piece)
    stream.write(ending)
    stream.sync()


def log_time_of(t: float) -> int:
    """Plant time in s as log time in ns."""
    return EPOCH_NS + round(t * 1e9)
