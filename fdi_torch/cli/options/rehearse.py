"""Try a monitor out on simulated runs: false alarms, delays, faults named, estimators side by side.

It is computed in pieces of seconds to minutes; Ctrl-C keeps those that are done, and --resume goes on.
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add_config, add_live

EXAMPLES = """
examples:
  fdi rehearse --config rehearsal.yaml
  fdi rehearse --config rehearsal.yaml --resume    go on where it was stopped
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "fdi_torch.config.rehearsal_file:RehearsalConfig", required=True)
    parser.add_argument("--out", metavar="DIR", help="folder for the log (default: logs)")
    parser.add_argument("--resume", action="store_true", help="go on from what a stopped run left in its log")
    add_live(parser)
