"""Diagnosability of an experiment: which faults it can detect and distinguish, and from which size.

The constants with a tolerance in the plant file are uncertain, as in `fdi train`. A fault of the smallest detectable
size is missed with a probability of 5 %, at a false-alarm rate of 0.1 %.
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add, names, seconds

STEP, SUMMARY = "plan", "which faults an experiment can detect and distinguish, and from which size"
EXAMPLES = """
examples:
  fdi diagnosability --plant three_tank --input '50 cm^3/s,50 cm^3/s'             two constant flows for 1000 s
  fdi diagnosability --plant rig.yaml --input run.csv --noise '2 mm'              the inputs of a recording
  fdi diagnosability --plant rig.yaml --input '20 m^3/h,50 %' --duration '1 day' --faults A.leak,link.plugging
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add(parser, "--plant", required=True)
    parser.add_argument(
        "--faults", metavar="NAME,...", type=names, default=(), help="such as T1.leak.size (default: the usual faults)"
    )
    parser.add_argument(
        "--input",
        "--recording",
        metavar="FILE|AMOUNTS",
        required=True,
        help="a recording (or a YAML file that lists one) whose inputs are used, or constant inputs "
        "such as '50 cm^3/s,50 cm^3/s'",
    )
    parser.add_argument(
        "--duration",
        metavar="TIME",
        type=seconds,
        help="duration of constant inputs, such as '2 h' (default: 1000 s for three_tank, longer for slower plants)",
    )
    add(parser, "--noise")
