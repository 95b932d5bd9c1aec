"""The catalogue of faults and unmodelled effects: places, parameters, when each begins, how it is written."""

from __future__ import annotations

import argparse

EXAMPLES = """
examples:
  fdi effects                                      all there are
  fdi effects --plant rig.yaml                     those that this plant can have, and where
  fdi effects leak pump_lag --plant rig.yaml       these in full: equation, parameters with units, how to write them
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", nargs="*", metavar="EFFECT", help="to be told in full")
    parser.add_argument("--plant", metavar="NAME|FILE", help="of which places and ranges are told")
