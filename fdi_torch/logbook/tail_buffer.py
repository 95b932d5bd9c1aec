"""Buffer for a file's tail, written once the file is closed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from fdi_torch.logbook.errors import log_error

IN_MEMORY = 4 << 20
"""Size beyond which the buffer is an unnamed file, which disappears with its process."""
_PIECE = 1 << 20


class TailBuffer:
    """The bytes after the first `start` of the final file at `path`. Raises LogError if the disk is full."""

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
