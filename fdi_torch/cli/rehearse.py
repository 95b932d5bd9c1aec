"""`fdi rehearse`: what it does and prints. Its options: `options/rehearse.py`.

Path: cli.rehearse.run → config.rehearsal_file.load_rehearsal → jobs.study.rehearse
"""

from __future__ import annotations

import argparse

from fdi_torch.cli.options import live, overrides
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.config.rehearsal_file import load_rehearsal
from fdi_torch.jobs.study import rehearse


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    rehearsal = load_rehearsal(arguments.config, overrides(arguments))
    with live(arguments, rehearsal.name, screen) as listener, screen.progress(rehearsal.name) as advance:
        done = rehearse(rehearsal, arguments.resume, advance, listener)
    for table in done.tables:
        screen.show(table)
        screen.say()
    screen.say(f"{done.computed} of {done.tasks} tasks in {done.seconds:.0f} s; {log_words(done.log)}")
    tables = [{"title": table.title, "rows": table.records} for table in done.tables]
    screen.result(
        {"format": "fdi_torch.rehearsal/1", "tables": tables, "computed": done.computed, "log": str(done.log)}
    )
    return 0
