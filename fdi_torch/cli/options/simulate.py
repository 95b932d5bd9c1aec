"""Write the recording that `simulate:` of a run file describes: plant, inputs, faults and noise, as CSV with units."""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add, add_config

STEP, SUMMARY = "describe", "generate a recording from a plant, inputs, faults and noise"
EXAMPLES = """
examples:
  fdi simulate --config rig.yaml --out .           writes rig.csv, or rig_2.csv if rig.csv exists
  fdi simulate --config rig.yaml --out . --replace writes rig.csv in any case
  fdi simulate --set simulate.faults.T1.leak=0.3   the built-in example with another fault
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "fdi_torch.config.run_file:RunConfig", example="simulate.faults.T1.leak=0.3")
    add(parser, "--out", "--seed")
    add(parser, "--replace", help="replace a recording of the same name")
