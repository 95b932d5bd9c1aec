"""Write a commented minimal file: a plant, or a run, monitor, rehearsal or study of a plant."""

STEP, SUMMARY = "describe", "write a commented minimal file: a plant, run, monitor, rehearsal or study"
QUICK = True
EXAMPLES = """
examples:
  fdi new plant --out rig.yaml                     then fdi check --plant rig.yaml
  fdi new plant --recording trend.xlsx --out rig.yaml      pumps and sensors from the columns of a recording
  fdi new run --plant rig.yaml --recording trend.xlsx      writes run.yaml; then fdi train --config run.yaml
  fdi new monitor --plant rig.yaml --recording trend.xlsx --out watch.yaml
  fdi new rehearsal --plant rig.yaml       validates a monitor by simulation: fdi rehearse --config rehearsal.yaml
  fdi new study --plant three_tank
"""
ARGUMENTS = {
    "kind": {"choices": ("plant", "run", "monitor", "rehearsal", "study"), "help": "kind of file"},
    "--plant": {"metavar": "NAME|FILE", "default": "three_tank", "help": "its plant (three_tank)"},
    "--recording": {
        "metavar": "FILE",
        "help": "a recording: its columns make the plant; a run or monitor reads it, a monitor also a URL such as mqtt://HOST",
    },
    "--out": {"metavar": "FILE", "help": "the new file (KIND.yaml); existing files are never replaced"},
}
