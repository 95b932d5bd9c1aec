"""Show the logs of a folder as pages on this machine: list, filter, sort, compare, and follow running jobs.

The pages need no network, and only this machine can reach them. Where the browser runs scripts, the charts of a report
are interactive. Ctrl-C ends the command.
"""

STEP, SUMMARY = "look", "show the logs of a folder as local pages: list, compare, follow running jobs"
QUICK = True
EXAMPLES = """
examples:
  fdi view                                         the logs in ./logs
  fdi view /data/runs --port 8080 --open
  fdi view --list "2026-11-24 leak"                the logs of that day about a leak, on the terminal
  fdi view --list train                            the logs of fdi train
"""
ARGUMENTS = {
    "folder": {
        "metavar": "FOLDER",
        "nargs": "?",
        "default": "logs",
        "help": "folder of logs, with its subfolders (default: logs)",
    },
    "--list": {
        "metavar": "WORDS",
        "nargs": "?",
        "const": "",
        "help": "only print the logs, latest first; WORDS: those with them in name, kind, command, start, verdict or "
        "state",
    },
    "--port": {"metavar": "N", "type": int, "default": 0, "help": "port of the pages (default: any free one)"},
    "--open": {"action": "store_true", "help": "open the list in the browser"},
}
