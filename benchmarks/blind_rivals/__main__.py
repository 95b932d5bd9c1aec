"""`python -m benchmarks.blind_rivals [options of fdi challenge] [--no-bic]`: the blind benchmark, and rivals."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping
from typing import Any

from benchmarks.blind_rivals.one_at_a_time import one_at_a_time
from benchmarks.blind_rivals.regression_baselines import gaussian_process, sparse_regression, split_f_test
from fdi_torch.blind.benchmark import Diagnosis
from fdi_torch.cli import challenge
from fdi_torch.cli.options import add_arguments
from fdi_torch.cli.screen import Screen
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

REGRESSIONS: Mapping[str, Diagnosis] = {f.__name__: f for f in (split_f_test, sparse_regression, gaussian_process)}
"""Fast competing methods."""


def one_at_a_time_bic(
    plant: PlantDescription, recording: Recording, holdout: Recording, leave_out: Collection[str] = ()
) -> dict[str, Any]:
    return one_at_a_time(plant, recording, leave_out=tuple(leave_out))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blind_rivals", description=__doc__)
    add_arguments(parser, "challenge")
    parser.add_argument("--no-bic", action="store_true", help="without the slow one, one effect at a time by BIC")
    arguments = parser.parse_args()
    slow = {} if arguments.no_bic else {"one_at_a_time_bic": one_at_a_time_bic}
    challenge.run(arguments, Screen(json=False, quiet=False), {**REGRESSIONS, **slow})


if __name__ == "__main__":
    main()
