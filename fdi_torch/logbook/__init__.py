"""Logs of runs in MCAP: written, read, repaired, inspected, compared and replayed. The only importer of mcap."""

from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.fingerprint import content_hash
from fdi_torch.logbook.follow import follow
from fdi_torch.logbook.reader import Message, Run, read_run
from fdi_torch.logbook.recover import Recovery, recover
from fdi_torch.logbook.signals import Signals, arrays, mapped_signals, own_signals, series
from fdi_torch.logbook.terminate import Terminated, exit_on_sigterm
from fdi_torch.logbook.writer import RunLog

__all__ = [
    "LogError",
    "Message",
    "Recovery",
    "Run",
    "RunLog",
    "Signals",
    "Terminated",
    "arrays",
    "content_hash",
    "exit_on_sigterm",
    "follow",
    "mapped_signals",
    "own_signals",
    "read_run",
    "recover",
    "series",
]
