"""Atomic writing of files, and disk errors as one sentence with advice."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile

_CAUSES = {
    errno.ENOSPC: "the disk is full; free some space",
    errno.EDQUOT: "the disk quota is used up; free some space",
    errno.EFBIG: "the limit on file size is reached; raise it (ulimit -f)",
    errno.EACCES: "the folder or file may not be written or read; choose another or change its permissions",
    errno.EPERM: "the folder or file may not be written or read; choose another or change its permissions",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.ENOENT: "there is no such file or folder; check the path",
    errno.EEXIST: "a part of the path is a file, not a folder; choose another folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder; choose another folder",
    errno.EISDIR: "it is a folder; name a file",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.EIO: "the device reports an input/output error; use another disk",
}


class DiskError(OSError):
    """A file cannot be written. The text is one sentence that names the file and a remedy."""


def sentence(place: Path | str, error: OSError) -> str:
    """The operating system's error on a file as a sentence with advice."""
    if error.errno == errno.EEXIST and Path(place).is_file():
        return f"{place}: it exists already; choose another name, or delete it"
    return f"{place}: {_CAUSES.get(error.errno or 0, (error.strerror or str(error)).lower())}"


@contextmanager
def named_errors(place: Path | str, kind: type[OSError] = DiskError) -> Iterator[None]:
    """A context in which the operating system's errors name the file and become errors of that kind."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        if error.errno is None:  # one of this program's errors, which is a sentence already
            raise
        raise kind(sentence(place, error)) from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A context that yields a temporary path for a new version of a file, which replaces the file if no error occurs.

    Missing folders are created. A device, such as /dev/stdout, is written directly. Raises DiskError.
    """
    with named_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.is_file():
            yield path
            return
        target = path.resolve()
        new = target.with_name(f".{target.stem}.{os.getpid()}{target.suffix}")
        try:
            yield new
            os.replace(new, target)
        finally:
            new.unlink(missing_ok=True)


def expect_writable(path: Path) -> None:
    """Raises DiskError if no file can be written at that path, before long work for it; creates missing folders."""
    with named_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        TemporaryFile(dir=path.parent).close()


def write_text(path: Path, text: str) -> Path:
    """Write a text file (UTF-8) atomically; characters outside UTF-8 become question marks. Raises DiskError."""
    with replacing(path) as new:
        new.write_text(text, encoding="utf-8", errors="replace")
    return path
