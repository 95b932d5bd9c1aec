"""Reading of a log while it is written: messages as its chunks reach the disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from mcap.opcode import Opcode

from fdi_torch.logbook import scan
from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.reader import Directory, Message, map_file


def follow(
    path: str | Path,
    topics: Collection[str] | None = None,
    idle_seconds: float = 30.0,
    poll_seconds: float = 0.1,
    on_damage: Callable[[scan.Damage], None] = lambda damage: None,
) -> Iterator[Message]:
    """Messages of a growing log from its start, as they arrive; ends when the log is finished.

    path: NAME.mcap, which may not exist yet (`NAME.mcap.partial` grows meanwhile), or any growing file. Damaged parts
    are passed to `on_damage` and skipped. Raises LogError if nothing arrives for `idle_seconds`.
    """
    tail, quiet_since = _Tail(Path(path), on_damage), time.monotonic()
    while True:
        finished, place = tail.finished(), tail.place
        yield from (message for message in tail.new_messages() if topics is None or message.topic in topics)
        if finished:
            return
        if tail.place != place:
            quiet_since = time.monotonic()
        elif time.monotonic() - quiet_since > idle_seconds:
            raise LogError(f"{path}: nothing came for {idle_seconds:g} s and the log has no end; is its writer alive?")
        else:
            time.sleep(poll_seconds)


class _Tail:
    """The position up to which a growing file has been read, under its unfinished and then its final name."""

    def __init__(self, path: Path, on_damage: Callable[[scan.Damage], None]) -> None:
        self.final = path.with_suffix("") if path.suffix == ".partial" else path
        self.partial = self.final.with_name(self.final.name + ".partial")
        self.place: int | None = None
        self.on_damage = on_damage
        self.directory = Directory()

    def finished(self) -> bool:
        """Whether the file exists under its final name and is complete."""
        if self.partial.exists() or not self.final.exists() or not self.final.stat().st_size:
            return False
        return scan.ends_whole(map_file(self.final))

    def new_messages(self) -> Iterator[Message]:
        """Messages of the records completed since the last call."""
        source = self.partial if self.partial.exists() else self.final
        try:
            data = map_file(source) if source.stat().st_size else b""
        except (FileNotFoundError, LogError):
            if source.exists():
                raise
            return  # not there yet, or just finished: the next call finds it under its final name
        for part in scan.frames(data, self.place):
            if isinstance(part, scan.Damage):
                if part.end == len(data):
                    return  # still being written
                self.on_damage(part)
            elif part.opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    yield from self.directory.open(data, part)
                except scan.ChunkError as error:
                    self.on_damage(scan.Damage(part.start, part.end, str(error)))
            self.place = part.end
