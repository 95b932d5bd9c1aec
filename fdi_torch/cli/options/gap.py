"""Find where a plant file deviates from a recording, which unmodelled effect causes it, and how far the gap closes.

The verdict is one of four: no gap; a named cause; several plausible explanations (with the input that would distinguish
them); or a gap that no effect of the library explains (with its location and shape). Initial levels and the constants
with a tolerance in the plant file are always refitted and do not count as a gap.

CSV headers are name_unit, as in t_s,Q1_cm3_s,h1_cm. `fdi report LOG` makes a page of the answer, `fdi replay LOG`
repeats the diagnosis from its log. `fdi plan` lists beforehand what planned inputs cannot show; `fdi refit` fits the
causes that were adopted together with all constants.
"""

from fdi_torch.cli.options import shared

MOST_CAUSES = 4

STEP, SUMMARY = "diagnose", "find where and by which effect a plant file deviates from a recording"
LONG = True
EXAMPLES = """
examples:
  fdi gap --plant three_tank --recording run.csv                       location and effect
  fdi gap --plant three_tank --recording run.csv --holdout other.csv   and how far the gap closes on other.csv
  fdi gap --plant rig.yaml --recording run.csv --adopt better.yaml     write the plant file with the causes
  fdi gap --plant rig.yaml --recording run.csv --adopt calibrated.yaml --narrow    calibrate despite disturbed flows
  fdi gap --plant rig.yaml --recording run.csv --library pump_lag,T1.leak
  fdi gap --plant rig.yaml --recording runs.yaml --most 8              several recordings together, many causes
"""
_DEFAULT = "for about 1500 steps, not below that of the samples; shorter where levels move fast"
_STANDARD_ERRORS = "with the constants' standard errors as tolerances where smaller"
ARGUMENTS = {
    **shared("--plant", "--recording", required=True),
    **shared("--holdout", "--library", "--leave-out"),
    **shared("--step", help=f"integration step (default: {_DEFAULT})"),
    "--most": {
        "metavar": "N",
        "type": int,
        "default": MOST_CAUSES,
        "help": f"largest number of effects ({MOST_CAUSES})",
    },
    "--named-only": {"action": "store_true", "help": "report the best named effect instead of `unknown`"},
    **shared("--adopt", help="write the plant file with the causes added to its effects"),
    **shared("--replace"),
    "--with-constants": {"action": "store_true", "help": "--adopt also writes the constants fitted with the causes"},
    **shared("--narrow", help=f"as --with-constants, {_STANDARD_ERRORS}"),
    **shared("--out", default="logs", help="folder for log, gap.json and next_input.csv (a second run: gap_2.json)"),
}
