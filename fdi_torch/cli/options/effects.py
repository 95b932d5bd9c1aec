"""The catalogue of faults and unmodelled effects: locations, parameters, onset, and how to write them."""

from fdi_torch.cli.options import shared

STEP, SUMMARY = "describe", "show the catalogue of faults and unmodelled effects"
QUICK = True
EXAMPLES = """
examples:
  fdi effects                                      list all effects
  fdi effects --plant rig.yaml                     list those that this plant can have, with their locations
  fdi effects leak pump_lag --plant rig.yaml       show equation, parameters with units, and how to write them
"""
ARGUMENTS = {
    "names": {"nargs": "*", "metavar": "EFFECT", "help": "effects to show in full"},
    **shared("--plant", help="plant whose locations and ranges are shown"),
}
