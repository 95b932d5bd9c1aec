"""Examine a plant, and recordings before any fit: clock, gaps, clipped, frozen or rounded channels, units, masks.

Exit code 4 if the plant file still has placeholders of `fdi new plant`, or if recording and plant contradict each
other.
"""

from fdi_torch.cli.options import config, keys, shared

STEP, SUMMARY = "describe", "examine a plant and a recording before any fit"
QUICK = True
EXAMPLES = """
examples:
  fdi check --plant rig.yaml                       the plant alone
  fdi check --plant rig.yaml --picture rig.png     and a drawing of it
  fdi check --plant rig.yaml --recording run.csv   the plant and a recording
  fdi check --plant rig.yaml --recording runs.yaml    all recordings that a YAML file maps to the plant
  fdi check --config own.yaml                      all recordings of a run file
  fdi check --keys                                 the keys of a plant file
"""
ARGUMENTS = {
    "file": {"nargs": "?", "help": "a recording, as --recording FILE"},
    **shared("--recording", "--plant"),
    "--picture": {"metavar": "FILE", "help": "draw the rig (PNG or SVG)"},
    **config(),
    **keys("a plant file", "fdi_torch.config.plant_file:PlantConfig"),
}
