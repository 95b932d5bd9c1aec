"""What planned inputs cannot show: effects that stay hidden, and pairs of effects that they cannot separate.

The recording needs times and inputs only; readings in it are ignored. `fdi gap` itself writes the input that
distinguishes its two likeliest explanations (next_input.csv).
"""

from fdi_torch.cli.options import shared

STEP, SUMMARY = "plan", "list what planned inputs cannot show, before an experiment"
EXAMPLES = """
examples:
  fdi plan --plant rig.yaml --recording planned.csv
  fdi plan --plant rig.yaml --recording planned.csv --noise '0.5 mm' --library leak,plugging
"""
ARGUMENTS = {**shared("--plant", "--recording", required=True), **shared("--library", "--noise")}
