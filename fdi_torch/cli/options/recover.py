"""Copy everything intact of a broken or unfinished log to a new one; exit code 3 if something was lost."""

from __future__ import annotations

import argparse

STEP, SUMMARY = "look", "recover a broken or unfinished log"
EXAMPLES = """
examples:
  fdi recover logs/own.mcap.partial                writes logs/own.recovered.mcap
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="BROKEN.mcap", help="a damaged log, or one that was not finished (.partial)")
    parser.add_argument("--out", metavar="FILE", help="the new log (default: NAME.recovered.mcap beside it)")
