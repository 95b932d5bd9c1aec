"""Show what a log contains and whether it is intact (any MCAP file), or with --topic export its messages."""

STEP, SUMMARY = "look", "show what a log contains and whether it is intact, or export its messages"
QUICK = True
FORMATS = ("csv", "ndjson", "npz")  # those of logbook.export
EXAMPLES = """
examples:
  fdi inspect logs/own.mcap                        contents and integrity
  fdi inspect logs/own.mcap --topic /plant/output --out output.csv
  fdi inspect logs/own.mcap --layout own.json      to be imported in Foxglove or Lichtblick
  fdi inspect logs/own.mcap --attachment config.yaml
"""
ARGUMENTS = {
    "log": {"metavar": "RUN.mcap", "help": "an MCAP file, complete or not"},
    "--topic": {"metavar": "T", "help": "write the messages of this topic instead"},
    "--format": {"choices": FORMATS, "default": "csv", "help": "output format (default: csv)"},
    "--attachment": {"metavar": "NAME", "help": "write this attachment instead, such as config.yaml"},
    "--layout": {"metavar": "FILE.json", "help": "write a layout for Foxglove and Lichtblick that shows this very log"},
    "--out": {
        "metavar": "FILE|DIR",
        "help": "file for the messages (default: standard output), folder for an attachment",
    },
}
