"""Copy everything intact of a broken or unfinished log to a new one; exit code 3 if something was lost."""

STEP, SUMMARY = "look", "recover a broken or unfinished log"
EXAMPLES = """
examples:
  fdi recover logs/own.mcap.partial                writes logs/own.recovered.mcap
"""
ARGUMENTS = {
    "log": {"metavar": "BROKEN.mcap", "help": "a damaged log, or one that was not finished (.partial)"},
    "--out": {"metavar": "FILE", "help": "the new log (default: NAME.recovered.mcap beside it)"},
}
