"""Follow a recording: alarms, which fault since when and how large, and recoveries, one line an event."""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add_config, add_live, seconds

EXAMPLES = """
examples:
  fdi monitor --config monitor.yaml                along a recording
  fdi monitor --config monitor.yaml --follow       along a CSV file that is still being written
  fdi monitor --config monitor.yaml --resume       on where a killed run stopped
  fdi monitor --config monitor.yaml --live         shown in Foxglove or Lichtblick meanwhile
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "fdi_torch.config.monitor_file:MonitorConfig", required=True)
    parser.add_argument("--out", metavar="DIR", help="folder for the log (default: logs)")
    parser.add_argument(
        "--follow", action="store_true", help="the file is still being written: events as its samples come"
    )
    parser.add_argument(
        "--idle", metavar="TIME", type=seconds, default=60.0, help="--follow: end after so long without a sample (60 s)"
    )
    parser.add_argument("--resume", action="store_true", help="go on where a killed run of the same file stopped")
    add_live(parser)
