"""Repeat an experiment many times and summarise: bias, error against the Cramer-Rao bound, coverage, failures.

The trials run in this process or, with --cluster, on a Dask cluster, with the same numbers.
"""

from fdi_torch.cli.options import config, shared

STEP, SUMMARY = "validate", "repeat an experiment many times: errors against their bounds, coverage, failures"
LONG = True
EXAMPLES = """
examples:
  fdi study --config study.yaml
  fdi study --config study.yaml --resume           continue a stopped run
  fdi study --config study.yaml --cluster local    on all cores, with Dask
"""
ARGUMENTS = {
    **config("fdi_torch.config.study_file:StudyFile", required=True, kind="study", example="study.trials=100"),
    **shared("--out", "--seed", "--device", "--live", "--resume", "--cluster"),
}
