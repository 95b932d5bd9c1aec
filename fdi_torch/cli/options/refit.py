"""Fit all effects and constants of a plant file to recordings together, without searching for causes.

Use it to calibrate a plant file with a fault-free recording, and after `fdi gap --adopt`. Every constant with a
tolerance and every number of an effect is fitted; values under `varying` belong to each recording. The error of each
sensor is reported, with each value and its standard error.
"""

from fdi_torch.cli.options import names, shared

STEP, SUMMARY = "diagnose", "fit all effects and constants of a plant file together, without a search"
LONG = True
EXAMPLES = """
examples:
  fdi refit --plant rig.yaml --recording run.csv --adopt calibrated.yaml --narrow      calibrate the constants
  fdi refit --plant second.yaml --recording runs.yaml --adopt final.yaml
  fdi refit --plant rig.yaml --recording run.csv --hold 'h?.offset,*.sensor_lag.*'
  fdi refit --plant rig.yaml --recording runs.yaml --leave-one-file-out --settle 30   predict each file without it
"""
ARGUMENTS = {
    **shared("--plant", "--recording", required=True),
    **shared("--holdout", help="other recordings of the same rig, whose error before and after the fit is shown"),
    **shared("--leave-out", help="effects of the plant file that the fit leaves out, at all of their places"),
    **shared("--step", help="integration step (default: half the sampling interval)"),
    "--hold": {"metavar": "NAME,...", "type": names, "default": (), "help": "do not fit these (* matches any name)"},
    **shared("--vary", help="values that may differ by recording; their variation is reported (* matches any name)"),
    "--white": {
        "metavar": "STD",
        "help": "treat errors as white, with this standard deviation of a level, such as '3 mm'",
    },
    "--leave-one-file-out": {
        "action": "store_true",
        "help": "also predict every file (every --holdout, if any) freely by a fit to all others",
    },
    **shared("--start-samples", "--settle"),
    **shared("--adopt", help="write the plant file with the fitted values"),
    **shared("--replace"),
    **shared("--narrow", help="there, use the standard errors of the fit as tolerances where smaller"),
}
