"""`fdi report`: what it does and prints. Its options: `options/report.py`.

Path: cli.report.run → jobs.report.report → logbook.reader.read_run → report.material.gather → report.page.report_of →
report.page.page
"""

from __future__ import annotations

import argparse

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.jobs.report import report


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    with screen.progress("report") as advance:
        done = report(arguments.logs, arguments.out, pictures=arguments.pictures, tell=advance)
    for note in done.notes:
        screen.note(note)
    for log, headline in done.headlines.items():
        screen.say(f"{log}: {headline}")
    screen.say(f"page: {done.page}")
    if done.pictures:
        screen.say(f"{len(done.pictures)} pictures: {done.page.with_suffix('')}")
    pictures = [str(path) for path in done.pictures]
    screen.result({"format": "fdi_torch.report/1", "page": str(done.page), "pictures": pictures})
    return DONE
