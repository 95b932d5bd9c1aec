"""Write the recording that `simulate:` of a run file describes: plant, inputs, faults and noise, as CSV with units."""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add_config, add_run

EXAMPLES = """
examples:
  fdi simulate --config rig.yaml --out .           writes rig.csv
  fdi simulate --set simulate.faults.T1.leak=0.3   the built-in example with another fault
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "fdi_torch.config.run_file:RunConfig")
    add_run(parser)
