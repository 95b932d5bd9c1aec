"""The end of a file as it shall be, kept until it may replace what stands on disk meanwhile."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from fdi_torch.logbook.errors import log_error

IN_MEMORY = 4 << 20
"""Bytes beyond which they wait in a nameless file, that vanishes with its process."""
_PIECE = 1 << 20


class Rest:
    """Bytes that belong behind the first `start` of a file at `path`. Raises LogError where the disk has no room."""

    def __init__(self, path: Path, start: int) -> None:
        self.path, self.start = path, start
        self._bytes = tempfile.SpooledTemporaryFile(IN_MEMORY, dir=str(path.parent))  # noqa: SIM115

    def write(self, data: bytes) -> None:
        try:
            self._bytes.write(data)
        except OSError as error:
            raise log_error(self.path, error) from error

    def pieces(self) -> Iterator[bytes]:
        """All of them, from the first."""
        self._bytes.seek(0)
        while data := self._bytes.read(_PIECE):
            yield data

    def close(self) -> None:
        self._bytes.close()
