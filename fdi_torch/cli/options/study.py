"""Repeat an experiment many times and summarise: bias, error against the Cramer-Rao bound, coverage, failures.

The trials run in this process or, with --cluster, on a Dask cluster, with the same numbers.
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import add, add_config

STEP, SUMMARY = "validate", "repeat an experiment many times: errors against their bounds, coverage, failures"
LONG = True
EXAMPLES = """
examples:
  fdi study --config study.yaml
  fdi study --config study.yaml --resume           continue a stopped run
  fdi study --config study.yaml --cluster local    on all cores, with Dask
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "fdi_torch.config.study_file:StudyFile", required=True, kind="study", example="study.trials=100")
    add(parser, "--out", "--seed", "--device", "--live", "--resume", "--cluster")
