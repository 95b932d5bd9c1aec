"""Export a plant with its effects for other simulation tools: an FMU for co-simulation (FMI 2.0).

The FMU is self-contained and runs on machines of the same kind as this one. Inputs are the plant's recorded inputs,
outputs its levels and readings, parameters its constants and the parameters of its effects, all in SI.
"""

from fdi_torch.cli.options import shared

STEP, SUMMARY = "use", "export a plant as an FMU for other simulation tools"
EXAMPLES = """
examples:
  fdi export --plant rig.yaml --fmu rig.fmu                         the plant with the effects in its file
  fdi export --plant three_tank --fmu rig.fmu --effect T1.leak      with a leak whose size is 0 until it is set
"""
ARGUMENTS = {
    **shared("--plant", required=True),
    "--fmu": {"metavar": "FILE", "required": True, "help": "FMU to write"},
    "--effect": {
        "metavar": "PLACE.EFFECT",
        "action": "append",
        "default": [],
        "help": "a further effect, absent until one of its parameters is set",
    },
}
