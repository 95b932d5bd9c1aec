"""Recovery of a damaged log: a complete new log with everything before, between and after the damage; and the log of an
interrupted run, set aside so that the run can go on.

A chunk is taken only if its CRC is valid, and then completely, so that no damaged message is passed on. Metadata has no
CRC in MCAP: in a damaged file it is copied if its inner lengths agree, and may contain a wrong letter.
"""

from __future__ import annotations

import fcntl
import os
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from fdi_torch.disk import named_errors
from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.payload import unpack
from fdi_torch.logbook.reader import Run, read_run
from fdi_torch.logbook.scan import Damage, Frame
from fdi_torch.logbook.sink import Sink

RECORD = "fdi_torch.recovery"


@dataclass(frozen=True)
class Recovery:
    """target: the repaired file. messages: their number. lost: the gaps. ended: whether the run had come to its end."""

    source: Path
    target: Path
    messages: int
    lost: tuple[Damage, ...]
    ended: bool

    @property
    def whole(self) -> bool:
        """Whether nothing was lost, as far as the file shows."""
        return self.ended and not self.lost

    @property
    def sentence(self) -> str:
        """The result in words."""
        if self.whole:
            return f"{self.source}: the file is whole, all {self.messages} messages are in {self.target}"
        size, losses = sum(damage.end - damage.start for damage in self.lost), []
        if len(self.lost) == 1:
            losses.append(f"1 damaged stretch of {size} bytes is lost")
        elif self.lost:
            losses.append(f"{len(self.lost)} damaged stretches, {size} bytes in all, are lost")
        if not self.ended:
            losses.append("the run did not finish: at most its last second is missing")
        return f"{self.source}: {self.messages} messages saved in {self.target}; {'; '.join(losses)}"


def recover(source: str | Path, target: str | Path | None = None) -> Recovery:
    """Write the readable parts of `source` to the new file `target`, by default NAME.recovered.mcap beside it.

    Raises LogError if the source cannot be opened or is not MCAP, or if the target cannot be written.
    """
    source = Path(source)
    name = source.name.removesuffix(".partial").removesuffix(".mcap")
    target = source.with_name(f"{name}.recovered.mcap") if target is None else Path(target)
    run = read_run(source, salvage=True)
    sink = Sink(target, run.library, run.profile)
    try:
        try:
            messages = _copy_records(run, sink)
            lost = tuple(sorted(run.damages, key=lambda damage: damage.start))
            done = Recovery(source, target, messages, lost, run.ended)
            sink.metadata(RECORD, _record(done))
        except BaseException:
            sink.abandon()
            raise
        sink.finish()
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    return done


def _record(recovery: Recovery) -> dict[str, str]:
    gaps = {f"lost.{i}": f"{gap.start} to {gap.end}: {gap.reason}" for i, gap in enumerate(recovery.lost)}
    about = {"source": recovery.source.name, "messages": str(recovery.messages), "ended": str(recovery.ended).lower()}
    return {**about, "lost": str(len(recovery.lost)), **gaps}


def _copy_records(run: Run, sink: Sink) -> int:
    """Copy metadata, attachments and messages in order of the file; returns the number of messages."""
    count = 0
    for part in run.walk():
        if not isinstance(part, Frame):
            count += 1
            sink.message(part.channel, part.log_time, part.publish_time, part.sequence, part.data)
        elif part.opcode == Opcode.METADATA:
            sink.metadata(*run.metadata_at(part))
        elif part.opcode == Opcode.ATTACHMENT:
            sink.attachment(*run.attachment_at(part))
    return count


def set_aside(path: str | Path) -> Path | None:
    """Rename the unfinished log of `NAME.mcap`, so that the run can be written again; None if there is none.

    The new name is NAME.mcap.partial.1, or the next free number. Raises LogError if its writer is still running.
    """
    partial = Path(f"{path}.partial")
    if not partial.exists():
        return None
    with named_errors(partial, LogError), open(partial, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LogError(f"{partial}: another run is writing this file; wait for it, or stop it") from None
        target = next(p for n in range(1, 10**6) if not (p := Path(f"{partial}.{n}")).exists())
        os.rename(partial, target)
    return target


def unfinished(path: str | Path) -> Run | None:
    """The unfinished log of `NAME.mcap`, renamed and opened; None if there is none."""
    aside = set_aside(path)
    return read_run(aside, salvage=True) if aside else None


def last_state(run: Run) -> tuple[int, dict[str, np.ndarray]] | None:
    """The last logged state of the search: generation and arrays; None if none was logged."""
    latest = deque(run.messages(["/estimator/de/population"]), maxlen=1)
    return (int(latest[0].payload["generation"]), unpack(latest[0].payload)) if latest else None
