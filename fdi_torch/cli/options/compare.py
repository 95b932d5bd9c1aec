"""Compare runs: configuration, versions, data, results with their errors, convergence and residuals."""

STEP, SUMMARY = "look", "compare runs: settings, data and results"
QUICK = True
EXAMPLES = """
examples:
  fdi compare logs/before.mcap logs/after.mcap
  fdi compare logs/*.mcap --csv all.csv --pictures pictures
"""
ARGUMENTS = {
    "logs": {"nargs": "+", "metavar": "RUN.mcap", "help": "two or more logs"},
    "--csv": {"metavar": "FILE", "help": "also write the whole comparison as CSV"},
    "--pictures": {"metavar": "DIR", "help": "also write convergence and residuals as PNG and SVG"},
}
