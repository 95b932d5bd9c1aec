"""Find where a plant file deviates from a recording, which unmodelled effect causes it, and how far the gap closes.

The verdict is one of four: no gap; a named cause; several plausible explanations (with the input that would distinguish
them); or a gap that no effect of the library explains (with its location and shape). Initial levels and the constants
with a tolerance in the plant file are always refitted and do not count as a gap.

CSV headers are name_unit, as in t_s,Q1_cm3_s,h1_cm. `fdi report LOG` makes a page of the answer, `fdi replay LOG`
repeats the diagnosis from its log.
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import seconds

MOST_CAUSES = 4
START_SAMPLES = 50

EXAMPLES = """
examples:
  fdi gap --plant three_tank --recording run.csv                       location and effect
  fdi gap --plant three_tank --recording run.csv --holdout other.csv   and how far the gap closes on other.csv
  fdi gap --plant rig.yaml --recording run.csv --adopt better.yaml     write the plant file with the causes
  fdi gap --plant rig.yaml --recording run.csv --library pump_lag,leak@T1
  fdi gap --plant rig.yaml --recording runs.yaml --most 8              several recordings together, many causes
  fdi gap --plant rig.yaml --recording planned.csv --plan              what the planned inputs cannot show
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plant", metavar="NAME|FILE", required=True, help="a shipped plant, or a plant file")
    parser.add_argument(
        "--recording", metavar="FILE", required=True, help="CSV or MCAP file, or a YAML file with `recordings`"
    )
    parser.add_argument(
        "--holdout", metavar="FILE", nargs="+", default=[], help="other recordings of the same rig, for validation only"
    )
    parser.add_argument("--library", metavar="EFFECT,...", help="effects to search (EFFECT@PLACE for one), or all")
    parser.add_argument("--leave-out", metavar="EFFECT,...", default="", help="effects to leave out of the library")
    parser.add_argument("--step", metavar="S", type=float, help="integration step, s (default: as sampled, <= 5)")
    parser.add_argument(
        "--most", metavar="N", type=int, default=MOST_CAUSES, help=f"largest number of effects ({MOST_CAUSES})"
    )
    parser.add_argument("--named-only", action="store_true", help="report the best named effect instead of `unknown`")
    parser.add_argument("--adopt", metavar="FILE", help="write the plant file with the causes added to its effects")
    parser.add_argument(
        "--with-constants", action="store_true", help="--adopt also writes the constants fitted with the causes"
    )
    _add_refit_arguments(parser)
    parser.add_argument("--plan", action="store_true", help="only report what the recording's inputs cannot show")
    parser.add_argument("--noise", metavar="STD", type=float, default=1e-3, help="for --plan: of a reading, SI (0.001)")
    parser.add_argument("--out", metavar="DIR", default="logs", help="folder for log, gap.json and next_input.csv")


def _add_refit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--refit", action="store_true", help="no search: fit the plant's own effects and constants together"
    )
    parser.add_argument(
        "--hold", metavar="NAME,...", default="", help="with --refit: do not fit these (* matches any name)"
    )
    parser.add_argument(
        "--white", metavar="STD", type=float, help="with --refit: treat errors as white, with this std, SI"
    )
    parser.add_argument(
        "--vary",
        metavar="NAME,...",
        default="",
        help="with --refit: values that may differ by recording; their variation is reported (* matches any name)",
    )
    parser.add_argument(
        "--in-turn",
        action="store_true",
        help="with --refit: also leave-one-file-out validation by free runs of every file (of every --holdout, if any)",
    )
    parser.add_argument(
        "--start-samples",
        metavar="N",
        type=int,
        default=START_SAMPLES,
        help=f"with --in-turn: samples for the initial levels ({START_SAMPLES})",
    )
    parser.add_argument(
        "--settle", metavar="TIME", type=seconds, help="with --in-turn: as in `fdi predict`, instead of --start-samples"
    )
