"""Errors of log files as one sentence with advice."""

from __future__ import annotations

from pathlib import Path

from fdi_torch.disk import sentence


class LogError(OSError):
    """A log cannot be written or read. The text is one sentence that names the file and a remedy."""


def log_error(path: Path, error: OSError) -> LogError:
    """The LogError for an operating system's error on `path`."""
    return LogError(sentence(path, error))
