"""What goes wrong with a log file, as one sentence a user can act on."""

from __future__ import annotations

from pathlib import Path

from fdi_torch.disk import sentence


class LogError(OSError):
    """A log cannot be written or read. Its text is one sentence that names the file and what to do."""


def log_error(path: Path, error: OSError) -> LogError:
    """The sentence for an operating system's error on `path`."""
    return LogError(sentence(path, error))
