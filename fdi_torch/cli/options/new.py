"""Write a commented minimal file to begin with: a plant, or a run, monitor or study of a plant."""

from __future__ import annotations

import argparse

EXAMPLES = """
examples:
  fdi new plant --out rig.yaml                     then fdi check --plant rig.yaml
  fdi new run --plant rig.yaml                     writes run.yaml; then fdi train --config run.yaml
  fdi new monitor --plant rig.yaml --out watch.yaml
  fdi new study --plant three_tank
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", choices=("plant", "run", "monitor", "study"), help="of file")
    parser.add_argument("--plant", metavar="NAME|FILE", default="three_tank", help="what it is about (three_tank)")
    parser.add_argument("--out", metavar="FILE", help="the new file (KIND.yaml); one that is there is never replaced")
