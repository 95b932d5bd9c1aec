"""Write the recording that `simulate:` of a run file describes: plant, inputs, faults and noise, as CSV with units."""

from fdi_torch.cli.options import config, shared

STEP, SUMMARY = "describe", "generate a recording from a plant, inputs, faults and noise"
EXAMPLES = """
examples:
  fdi simulate --config rig.yaml --out .           writes rig.csv, or rig_2.csv if rig.csv exists
  fdi simulate --config rig.yaml --out . --replace writes rig.csv in any case
  fdi simulate --set simulate.faults.T1.leak=0.3   the built-in example with another fault
"""
ARGUMENTS = {
    **config("fdi_torch.config.run_file:RunConfig", example="simulate.faults.T1.leak=0.3"),
    **shared("--out", "--seed"),
    **shared("--replace", help="replace a recording of the same name"),
}
