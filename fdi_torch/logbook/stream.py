"""The file under a log: nobody else writes it, and every error of the disk is one sentence."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import BinaryIO

from fdi_torch.logbook.errors import LogError, log_error

_PIECE = 1 << 20


class Stream:
    """An unbuffered file. Raises LogError where the path is taken or not writable; after an error it is dead.

    size: bytes written. dead: what ended it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        self.dead: LogError | None = None
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except FileExistsError:
            raise LogError(_taken(path)) from None
        except OSError as error:
            raise log_error(path, error) from error

    def write(self, data: bytes) -> None:
        self.expect_alive()
        rest = memoryview(data)
        try:
            while rest:
                done = os.write(self._file, rest)
                rest, self.size = rest[done:], self.size + done
        except OSError as error:
            self.dead = log_error(self.path, error)
            raise self.dead from error

    def copy(self, source: BinaryIO, start: int, end: int) -> None:
        """The bytes `start` to `end` of another file."""
        source.seek(start)
        while start < end:
            data = source.read(min(_PIECE, end - start))
            self.write(data)
            start += len(data)

    def expect_alive(self) -> None:
        if self.dead is not None:
            raise LogError(f"{self.dead}; nothing more is logged")

    def go_back(self, place: int) -> None:
        """What is written next stands at that place; all from there on is given up."""
        try:
            os.lseek(self._file, place, os.SEEK_SET)
        except OSError as error:
            raise log_error(self.path, error) from error
        self.size = place

    def sync(self) -> None:
        """All of it on disk, and nothing behind it."""
        try:
            os.ftruncate(self._file, self.size)
            os.fsync(self._file)
        except OSError as error:
            raise log_error(self.path, error) from error

    def close(self) -> None:
        os.close(self._file)


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
