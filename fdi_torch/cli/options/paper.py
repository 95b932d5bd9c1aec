"""Make the 2020 paper's tables and figures again, ours and its numbers side by side, as one page with pictures."""

from __future__ import annotations

import argparse

EXAMPLES = """
examples:
  fdi paper --out paper                            writes paper/README.md and its pictures
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", default="docs/paper", help="folder for the page (default: docs/paper)")
