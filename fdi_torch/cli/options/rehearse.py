"""Validate a monitor on simulated runs: false alarms, detection delays, isolation.

The work consists of tasks of seconds to minutes; Ctrl-C keeps those that are done, and --resume continues.
"""

from fdi_torch.cli.options import config, shared

STEP, SUMMARY = "monitor", "validate a monitor on simulated runs: false alarms, delays, isolation"
EXAMPLES = """
examples:
  fdi rehearse --config rehearsal.yaml             fdi new rehearsal --plant rig.yaml writes such a file
  fdi rehearse --config rehearsal.yaml --resume    continue a stopped run
"""
ARGUMENTS = {
    **config("fdi_torch.config.rehearsal_file:RehearsalConfig", required=True, kind="rehearsal", example="seed=2"),
    **shared("--out", "--resume", "--live"),
}
