"""Repeat an estimation, a study, a gap diagnosis or a monitor run from its log, and compare event by event.

With --set, repeat it with another setting. Exit code 3 if an event differs by more than the tolerance.
"""

from __future__ import annotations

import argparse

STEP, SUMMARY = "look", "repeat a logged run and compare, or try another setting"
EXAMPLES = """
examples:
  fdi replay logs/own.mcap                         repeat and compare
  fdi replay logs/own.mcap --set seed=7            with another seed
  fdi replay logs/study.mcap --trial 12            one trial of a study
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="RUN.mcap", help="a log of fdi train, study, gap or monitor")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="changed setting: another objective, seed, library ...; may be repeated",
    )
    parser.add_argument(
        "--trial", metavar="N", type=int, action="append", default=[], help="one trial of a study; may be repeated"
    )
    parser.add_argument("--out", metavar="FILE", help="the new log (with --set: NAME.what_if.mcap; otherwise not kept)")
