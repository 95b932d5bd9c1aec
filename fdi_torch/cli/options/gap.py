"""Find where a plant file deviates from a recording, which unmodelled effect causes it, and how far the gap closes.

The verdict is one of four: no gap; a named cause; several plausible explanations (with the input that would distinguish
them); or a gap that no effect of the library explains (with its location and shape). Initial levels and the constants
with a tolerance in the plant file are always refitted and do not count as a gap.

CSV headers are name_unit, as in t_s,Q1_cm3_s,h1_cm. `fdi report LOG` makes a page of the answer, `fdi replay LOG`
repeats the diagnosis from its log. `fdi plan` lists beforehand what planned inputs cannot show; `fdi refit` fits the
causes that were adopted together with all constants.
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add

MOST_CAUSES = 4

STEP, SUMMARY = "diagnose", "find where and by which effect a plant file deviates from a recording"
LONG = True
EXAMPLES = """
examples:
  fdi gap --plant three_tank --recording run.csv                       location and effect
  fdi gap --plant three_tank --recording run.csv --holdout other.csv   and how far the gap closes on other.csv
  fdi gap --plant rig.yaml --recording run.csv --adopt better.yaml     write the plant file with the causes
  fdi gap --plant rig.yaml --recording run.csv --adopt calibrated.yaml --narrow    calibrate despite disturbed flows
  fdi gap --plant rig.yaml --recording run.csv --library pump_lag,T1.leak
  fdi gap --plant rig.yaml --recording runs.yaml --most 8              several recordings together, many causes
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add(parser, "--plant", "--recording", required=True)
    add(parser, "--holdout", "--library", "--leave-out")
    default = "for about 1500 steps, not below that of the samples; shorter where levels move fast"
    add(parser, "--step", help=f"integration step (default: {default})")
    parser.add_argument(
        "--most", metavar="N", type=int, default=MOST_CAUSES, help=f"largest number of effects ({MOST_CAUSES})"
    )
    parser.add_argument("--named-only", action="store_true", help="report the best named effect instead of `unknown`")
    add(parser, "--adopt", help="write the plant file with the causes added to its effects")
    add(parser, "--replace")
    parser.add_argument(
        "--with-constants", action="store_true", help="--adopt also writes the constants fitted with the causes"
    )
    standard_errors = "with the constants' standard errors as tolerances where smaller"
    add(parser, "--narrow", help=f"as --with-constants, {standard_errors}")
    add(parser, "--out", default="logs", help="folder for log, gap.json and next_input.csv")
