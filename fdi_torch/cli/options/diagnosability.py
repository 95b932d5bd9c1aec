"""Diagnosability of an experiment: which faults it can detect and distinguish, and from which size.

The constants with a tolerance in the plant file are uncertain, as in `fdi train`. A fault of the smallest detectable
size is missed with a probability of 5 %, at a false-alarm rate of 0.1 %.
"""

from fdi_torch.cli.options import names, seconds, shared

STEP, SUMMARY = "plan", "which faults an experiment can detect and distinguish, and from which size"
EXAMPLES = """
examples:
  fdi diagnosability --plant three_tank --input '50 cm^3/s,50 cm^3/s'             two constant flows for 1000 s
  fdi diagnosability --plant rig.yaml --input run.csv --noise '2 mm'              the inputs of a recording
  fdi diagnosability --plant rig.yaml --input '20 m^3/h,50 %' --duration '1 day' --faults A.leak,link.plugging
"""
ARGUMENTS = {
    **shared("--plant", required=True),
    "--faults": {
        "metavar": "NAME,...",
        "type": names,
        "default": (),
        "help": "such as T1.leak.size (default: the usual faults)",
    },
    "--input --recording": {
        "metavar": "FILE|AMOUNTS",
        "required": True,
        "help": "a recording (or a YAML file that lists one) whose inputs are used, or constant inputs "
        "such as '50 cm^3/s,50 cm^3/s'",
    },
    "--duration": {
        "metavar": "TIME",
        "type": seconds,
        "help": "duration of constant inputs, such as '2 h' (default: 1000 s for three_tank, longer for slower plants)",
    },
    "--angles": {
        "action": "store_true",
        "help": "print the angles between the signatures of all pairs of faults, not only the small ones",
    },
    **shared("--noise"),
}
