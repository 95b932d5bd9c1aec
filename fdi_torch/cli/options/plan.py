"""What planned inputs cannot show: effects that stay hidden, and pairs of effects that they cannot separate.

The recording needs times and inputs only; readings in it are ignored. `fdi gap` itself writes the input that
distinguishes its two likeliest explanations (next_input.csv).
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add_library, add_plant_and_recording

NOISE = "1 mm"

STEP, SUMMARY = "plan", "list what planned inputs cannot show, before an experiment"
EXAMPLES = """
examples:
  fdi plan --plant rig.yaml --recording planned.csv
  fdi plan --plant rig.yaml --recording planned.csv --noise '0.5 mm' --library leak,plugging
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_plant_and_recording(parser)
    add_library(parser)
    parser.add_argument(
        "--noise",
        metavar="AMOUNT",
        default=NOISE,
        help=f"standard deviation of the readings: as a level ({NOISE}), or 'h1 = 1 mm, p2 = 2 mV'",
    )
