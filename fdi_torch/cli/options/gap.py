"""Where a plant file falls short of a recording, which unmodelled effect causes it, and how far the gap then closes.

The answer is one of four: no gap; a named cause; several explanations that stand (with the input that would part them);
or a gap that no effect of the library explains (with its place and shape). Calibration constants that the plant file
lists under tolerances, and the start levels, are refitted throughout and are no gap.

CSV headers are name_unit, as in t_s,Q1_cm3_s,h1_cm. `fdi report LOG` makes a page of the answer, `fdi replay LOG` does
it again from its log alone.
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import seconds

MOST_CAUSES = 4
START_SAMPLES = 50

EXAMPLES = """
examples:
  fdi gap --plant three_tank --recording run.csv                       where, and which effect
  fdi gap --plant three_tank --recording run.csv --holdout other.csv   also how far the gap closes on other.csv
  fdi gap --plant rig.yaml --recording run.csv --adopt better.yaml     write the plant file with the causes in it
  fdi gap --plant rig.yaml --recording run.csv --library pump_lag,leak@T1
  fdi gap --plant rig.yaml --recording runs.yaml --most 8               several recordings as one, many causes
  fdi gap --plant rig.yaml --recording planned.csv --plan              before any reading: what the inputs cannot tell
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plant", metavar="NAME|FILE", required=True, help="a shipped plant, or a plant file")
    parser.add_argument(
        "--recording", metavar="FILE", required=True, help="CSV or MCAP file, or a YAML file with `recordings`"
    )
    parser.add_argument(
        "--holdout", metavar="FILE", nargs="+", default=[], help="other recordings of the same rig, for closure only"
    )
    parser.add_argument("--library", metavar="EFFECT,...", help="effects to search (EFFECT@PLACE for one), or all")
    parser.add_argument("--leave-out", metavar="EFFECT,...", default="", help="effects to deny the diagnosis")
    parser.add_argument("--step", metavar="S", type=float, help="of the simulation, s (as sampled, on a bench <= 5)")
    parser.add_argument(
        "--most", metavar="N", type=int, default=MOST_CAUSES, help=f"effects at once, at most ({MOST_CAUSES})"
    )
    parser.add_argument("--named-only", action="store_true", help="never unknown: the best that has a name, on the way")
    parser.add_argument("--adopt", metavar="FILE", help="write the plant file with the causes found among its effects")
    parser.add_argument(
        "--with-constants", action="store_true", help="--adopt also writes the constants as fitted beside the causes"
    )
    _add_refit_arguments(parser)
    parser.add_argument("--plan", action="store_true", help="only say what the inputs of the recording can never show")
    parser.add_argument("--noise", metavar="STD", type=float, default=1e-3, help="for --plan: of a reading, SI (0.001)")
    parser.add_argument("--out", metavar="DIR", default="logs", help="folder for log, gap.json and next_input.csv")


def _add_refit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--refit", action="store_true", help="search nothing: fit the plant's own effects and constants together"
    )
    parser.add_argument(
        "--hold", metavar="NAME,...", default="", help="with --refit: leave these as they are (* is any name)"
    )
    parser.add_argument(
        "--white", metavar="STD", type=float, help="with --refit: slow errors count like fast ones, of that size, SI"
    )
    parser.add_argument(
        "--vary",
        metavar="NAME,...",
        default="",
        help="with --refit: each recording has its own value of these; how much they differ is told (* is any name)",
    )
    parser.add_argument(
        "--in-turn",
        action="store_true",
        help="with --refit: also free runs of every file (of every --holdout, if any) by a refit without that file",
    )
    parser.add_argument(
        "--start-samples",
        metavar="N",
        type=int,
        default=START_SAMPLES,
        help=f"with --in-turn: for the start levels ({START_SAMPLES})",
    )
    parser.add_argument(
        "--settle", metavar="TIME", type=seconds, help="with --in-turn: as `fdi predict` has it, in place of those"
    )
