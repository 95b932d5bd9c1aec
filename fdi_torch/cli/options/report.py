"""Make one HTML page of one or more logs: verdict, rig, readings, convergence, uncertainty, configuration, provenance.

The page needs no network. Where the browser runs scripts, its charts are interactive. It is written next to the (first)
log, or where --out says.
"""

STEP, SUMMARY = "look", "make one HTML page of one or more logs"
EXAMPLES = """
examples:
  fdi report logs/own.mcap                         writes logs/own.html
  fdi report logs/before.mcap logs/after.mcap --out both.html --pictures
"""
ARGUMENTS = {
    "logs": {"nargs": "+", "metavar": "RUN.mcap", "help": "logs, which may be unfinished or damaged"},
    "--out": {"metavar": "FILE|DIR", "help": "the page, or the folder for it"},
    "--pictures": {"action": "store_true", "help": "also write every picture as PNG and SVG"},
}
