"""Compare runs: configuration, versions, data, results with their errors, convergence and residuals."""

from __future__ import annotations

import argparse

STEP, SUMMARY = "look", "compare runs: settings, data and results"
QUICK = True
EXAMPLES = """
examples:
  fdi compare logs/before.mcap logs/after.mcap
  fdi compare logs/*.mcap --csv all.csv --pictures pictures
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="RUN.mcap", help="two or more logs")
    parser.add_argument("--csv", metavar="FILE", help="also write the whole comparison as CSV")
    parser.add_argument("--pictures", metavar="DIR", help="also write convergence and residuals as PNG and SVG")
