"""The file of a log: only one process writes it, and disk errors are raised with a sentence for the user."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from fdi_torch.disk import named_errors, sentence
from fdi_torch.logbook.errors import LogError


class ExclusiveFile:
    """An unbuffered file. Raises LogError if the path exists or is not writable; after a disk error it refuses writes.

    size: bytes written. dead: the error that ended it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        self.dead: LogError | None = None
        with named_errors(path, LogError):
            try:
                self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
            except FileExistsError:
                raise LogError(_taken(path)) from None
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def write(self, data: bytes) -> None:
        self.expect_alive()
        remaining = memoryview(data)
        try:
            while remaining:
                count = os.write(self._file, remaining)
                remaining, self.size = remaining[count:], self.size + count
        except OSError as error:
            self.dead = LogError(sentence(self.path, error))
            raise self.dead from None

    def expect_alive(self) -> None:
        if self.dead is not None:
            raise LogError(f"{self.dead}; nothing more is logged")

    def sync(self) -> None:
        with named_errors(self.path, LogError):
            os.fsync(self._file)

    def close(self) -> None:
        os.close(self._file)


def being_written(path: Path) -> bool:
    """Whether a process holds the file open as an `ExclusiveFile`. Raises OSError if it cannot be opened.

    Ask only about a file that is not empty; otherwise this check may lock the file before its writer does.
    """
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _taken(path: Path) -> str:
    """The reason why an existing file cannot be used: it is being written, or its writer was killed."""
    try:
        if being_written(path):
            return f"{path}: another run is writing this file; choose another name"
    except OSError as error:
        return sentence(path, error)
    return f"{path}: left by a run that did not end; save it with `fdi recover {path}`, then delete it"
