"""Reproduce the tables and figures of the 2020 paper, with published and computed numbers side by side on one page."""

from __future__ import annotations

import argparse

EXAMPLES = """
examples:
  fdi paper --out paper                            writes paper/README.md and its pictures
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", default="docs/paper", help="folder for the page (default: docs/paper)")
