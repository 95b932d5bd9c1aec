"""Repeat an estimation, a study, a gap diagnosis or a monitor run from its log, and compare event by event.

With --set, repeat it with another setting. Exit code 3 if an event differs by more than the tolerance.
"""

STEP, SUMMARY = "look", "repeat a logged run and compare, or try another setting"
EXAMPLES = """
examples:
  fdi replay logs/own.mcap                         repeat and compare
  fdi replay logs/own.mcap --set seed=7            with another seed
  fdi replay logs/study.mcap --trial 12            one trial of a study
"""
ARGUMENTS = {
    "log": {"metavar": "RUN.mcap", "help": "a log of fdi train, study, gap or monitor"},
    "--set": {
        "metavar": "KEY=VALUE",
        "action": "append",
        "default": [],
        "help": "changed setting: another objective, seed, library ...; may be repeated",
    },
    "--trial": {
        "metavar": "N",
        "type": int,
        "action": "append",
        "default": [],
        "help": "one trial of a study; may be repeated",
    },
    "--out": {"metavar": "FILE", "help": "the new log (with --set: NAME.what_if.mcap; otherwise not kept)"},
}
