"""Rewriting of a log: same records in the same order, in full chunks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from mcap.opcode import Opcode

from fdi_torch.logbook.reader import Run, read_run
from fdi_torch.logbook.scan import Frame
from fdi_torch.logbook.sink import Sink

Extra = Callable[[Run, int], Mapping[str, Mapping[str, str]]]


def copy_log(source: Path, target: Path, salvage: bool = False, extra: Extra | None = None) -> Run:
    """Write every readable record of `source` to the new file `target`, then the metadata of `extra`.

    extra: called with the run and the number of copied messages.
    """
    run = read_run(source, salvage=salvage)
    sink = Sink(target, run.library, run.profile)
    try:
        messages = _copy_records(run, sink)
        for name, values in (extra(run, messages) if extra else {}).items():
            sink.metadata(name, values)
    except BaseException:
        sink.abandon()
        raise
    sink.finish()
    return run


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
