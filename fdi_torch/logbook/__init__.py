"""Logs of runs in MCAP: writing, reading, recovering, inspecting, comparing and replaying. Only this package imports
mcap.
"""

from fdi_torch.logbook.compare import Comparison, align, compare, content_hash, labels_of
from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.exclusive_file import being_written
from fdi_torch.logbook.export import Inspection, export, export_attachment, inspect_log
from fdi_torch.logbook.follow import follow
from fdi_torch.logbook.layout import foxglove_layout
from fdi_torch.logbook.live import Live, serve
from fdi_torch.logbook.payload import as_array, unpack
from fdi_torch.logbook.reader import Message, Run, read_run
from fdi_torch.logbook.recover import Recovery, last_state, recover, set_aside, unfinished
from fdi_torch.logbook.replay import Replay, replay
from fdi_torch.logbook.signals import Signals, arrays, mapped_signals, number_at, own_signals, series
from fdi_torch.logbook.writer import KEPT, Listener, RunLog
