"""Examine a plant, and recordings before any fit: clock, gaps, clipped, frozen or rounded channels, units, masks.

Exit code 4 if the plant file still has placeholders of `fdi new plant`, or if recording and plant contradict each
other.
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add, add_config, add_keys

STEP, SUMMARY = "describe", "examine a plant and a recording before any fit"
QUICK = True
EXAMPLES = """
examples:
  fdi check --plant rig.yaml                       the plant alone
  fdi check --plant rig.yaml --picture rig.png     and a drawing of it
  fdi check --plant rig.yaml --recording run.csv   the plant and a recording
  fdi check --plant rig.yaml --recording runs.yaml    all recordings that a YAML file maps to the plant
  fdi check --config own.yaml                      all recordings of a run file
  fdi check --keys                                 the keys of a plant file
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", help="a recording, as --recording FILE")
    add(parser, "--recording", "--plant")
    parser.add_argument("--picture", metavar="FILE", help="draw the rig (PNG or SVG)")
    add_config(parser)
    add_keys(parser, "a plant file", "fdi_torch.config.plant_file:PlantConfig")
