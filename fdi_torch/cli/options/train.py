"""Estimate which faults are present in a recording, how large and how certain; with a log and a picture.

Without --config it runs the built-in example: three tanks with four faults (Table 3 of the 2020 paper),
simulated and diagnosed.
"""

from fdi_torch.cli.options import config, shared

STEP, SUMMARY = "diagnose", "estimate the sizes of faults in a recording"
LONG = True
EXAMPLES = """
examples:
  fdi train                                        the built-in example: simulated, then diagnosed
  fdi train --config own.yaml                      a recording of your own
  fdi train --config own.yaml --set estimate.search.population=40 --seed 3
  fdi train --config own.yaml --resume             continue a stopped run
"""
ARGUMENTS = {
    **config("fdi_torch.config.run_file:RunConfig"),
    **shared("--out", "--seed", "--device", "--live", "--resume"),
}
