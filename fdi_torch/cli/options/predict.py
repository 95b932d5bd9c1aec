"""Run a plant file freely along recordings; only the first samples of each are used, for the initial levels.

The error of the whole run is printed in each sensor's unit; with --settle, the error after that time. A run ends where
an input becomes unknown, and a new one starts where it is known again.
"""

from fdi_torch.cli.options import RECORDING, seconds, shared

STEP, SUMMARY = "diagnose", "run a plant freely along a recording and report the error"
EXAMPLES = """
examples:
  fdi predict --plant better.yaml --recording run.csv        one free run
  fdi predict --plant better.yaml --recording run.csv --beside rig.yaml --picture run.png
  fdi predict --plant rig.yaml a.csv b.csv --to 300          several recordings, the first 300 s of each
  fdi predict --plant rig.yaml --recording runs.yaml         recordings listed under `recordings`, as in a run file
  fdi predict --plant rig.yaml --recording run.csv --settle 30    estimate what varies by run from the first 30 s
  fdi predict --plant rig.yaml --recording run.csv --settle 60 --vary 'q?.gain'    and the pumps' gains of this run
  fdi predict --plant rig.yaml --recording run.csv --constant q1_cmd=0    an input that was not recorded
"""
ARGUMENTS = {
    "recordings": {"metavar": "recording", "nargs": "*", "help": "recordings, as --recording FILE"},
    **shared("--recording", action="append", default=[], help=f"{RECORDING}; may be repeated"),
    **shared("--plant", required=True),
    **shared("--start-samples", "--settle"),
    **shared("--vary", help="constants with a tolerance that are estimated there too (* matches any name)"),
    "--from": {"metavar": "TIME", "dest": "start", "type": seconds, "help": "first time used of each file"},
    "--to": {"metavar": "TIME", "dest": "stop", "type": seconds, "help": "last time used: 300, or '2 h'"},
    "--picture": {"metavar": "FILE", "help": "draw the run (PNG or SVG); of several, the last"},
    "--beside": {"metavar": "PLANT", "help": "another plant in the same table and picture, such as the previous one"},
    "--constant": {
        "metavar": "INPUT=VALUE",
        "action": "append",
        "default": [],
        "help": "an input that was not recorded, SI or with its unit",
    },
}
