"""The way into an MCAP file: one exclusive writer, channels registered at their first message, clear errors.

A chunk ends where it exceeds 256 KiB, before a metadata record or an attachment, and where `flush` is called:
files with equal contents and equal flushes are byte-identical.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mcap import records
from mcap.writer import CompressionType, Writer

from fdi_torch.logbook.channel import Channel
from fdi_torch.logbook.errors import LogError, log_error

PROFILE = "fdi_torch"
CHUNK_BYTES = 256 * 1024
EPOCH_NS = 946_684_800 * 10**9  # 2000-01-01T00:00:00Z: plant time 0; leaves room for negative times


class Stream:
    """An unbuffered file that nobody else writes. Raises LogError where the path is taken or not writable."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except FileExistsError:
            raise LogError(_taken(path)) from None
        except OSError as error:
            raise log_error(path, error) from error

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            done = os.write(self._file, rest)
            rest, self.size = rest[done:], self.size + done
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Nothing is held back."""

    def sync(self) -> None:
        os.fsync(self._file)

    def close(self) -> None:
        os.close(self._file)


class Sink:
    """An MCAP file being written. After an error of the disk it is dead and refuses further writes."""

    def __init__(self, path: Path, library: str, profile: str = PROFILE, compress: bool = True) -> None:
        self._stream = Stream(path)
        self.path = path
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._records: dict[int, tuple[records.Schema | None, records.Channel]] = {}
        self._told: set[int] = set()
        self._chunk_start = 0
        self._dead: LogError | None = None
        output: Any = self._stream
        self._writer = Writer(
            output,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD if compress else CompressionType.NONE,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._guarded(self._writer.start, profile, library)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return int(self._stream.size)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        self.flush()
        self._guarded(self._writer.add_metadata, name, dict(values))

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        self.flush()
        self._guarded(self._writer.add_attachment, EPOCH_NS, EPOCH_NS, name, media_type, data)

    def message(self, channel: Channel, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        if self._chunk_start != self.size:
            self._chunk_start, self._told = self.size, set()
        number = self._channels.get(channel) or self._register(channel)
        self._repeat_in_chunk(number)
        self._guarded(self._writer.add_message, number, log_time, data, publish_time, sequence)

    def flush(self) -> None:
        self._guarded(self._writer.flush)

    def finish(self) -> None:
        """Close the file as a whole one, on disk."""
        try:
            self._guarded(self._writer.finish)
            self._guarded(self._stream.sync)
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    def _register(self, channel: Channel) -> int:
        schema = (channel.schema_name, channel.schema_encoding, channel.schema_data)
        number = 0
        if channel.schema_name:
            number = self._schemas.get(schema) or self._guarded(self._writer.register_schema, *schema)
            self._schemas[schema] = number
        known = self._guarded(
            self._writer.register_channel, channel.topic, channel.encoding, number, dict(channel.metadata)
        )
        self._channels[channel] = known
        self._records[known] = _records(known, number, channel)
        self._told.add(known)
        return int(known)

    def _repeat_in_chunk(self, number: int) -> None:
        """Describe a channel in each chunk that uses it, so that no chunk needs another one to be read.

        The library has no public way to do so; should its inside change, only this repetition is lost.
        """
        if self._chunk_start != self.size:
            self._chunk_start, self._told = self.size, set()
        chunk = getattr(self._writer, "_Writer__chunk_builder", None)
        if number in self._told or chunk is None:
            return
        self._told.add(number)
        schema, channel = self._records[number]
        if schema is not None:
            chunk.add_schema(schema)
        chunk.add_channel(channel)

    def _guarded(self, call: Any, *arguments: Any) -> Any:
        if self._dead is not None:
            raise LogError(f"{self._dead}; nothing more is logged")
        try:
            return call(*arguments)
        except OSError as error:
            self._dead = log_error(self.path, error)
            raise self._dead from error


def _records(number: int, schema_id: int, channel: Channel) -> tuple[records.Schema | None, records.Channel]:
    """A channel and its schema (number 0: none) as records of the format."""
    schema = records.Schema(schema_id, channel.schema_data, channel.schema_encoding, channel.schema_name)
    told = records.Channel(number, channel.topic, channel.encoding, dict(channel.metadata), schema_id)
    return (schema if schema_id else None), told


def log_time_of(t: float) -> int:
    """Plant time in s as log time in ns."""
    return EPOCH_NS + round(t * 1e9)


def _taken(path: Path) -> str:
    """Why an existing file keeps us out: somebody writes it, or somebody was killed while writing it."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        return str(log_error(path, error))
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return f"{path}: another run is writing this file; choose another name"
    finally:
        os.close(file)
    return f"{path}: left by a run that did not end; save it with `fdi recover {path}`, then delete it"
