"""What goes wrong with a log file, as one sentence a user can act on."""

from __future__ import annotations

import errno
from pathlib import Path


class LogError(OSError):
    """A log cannot be written or read. Its text is one sentence that names the file and what to do."""


_CAUSES = {
    errno.ENOSPC: "the disk is full; free some space",
    errno.EDQUOT: "the disk quota is used up; free some space",
    errno.EFBIG: "the limit on file size is reached; raise it (ulimit -f)",
    errno.EACCES: "the folder or file may not be written or read; choose another or change its permissions",
    errno.EPERM: "the folder or file may not be written or read; choose another or change its permissions",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.ENOENT: "there is no such file or folder, and none can be made there; check the path",
    errno.EEXIST: "a part of the path is a file, not a folder; choose another folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder; choose another folder",
    errno.EISDIR: "it is a folder; name a file",
    errno.EIO: "the device reports an input/output error; use another disk",
}


def log_error(path: Path, error: OSError) -> LogError:
    """The sentence for an operating system's error on `path`."""
    cause = _CAUSES.get(error.errno or 0, (error.strerror or str(error)).lower())
    return LogError(f"{path}: {cause}")
