"""`fdi replay`: what it does and prints. Its options: `options/replay.py`.

Path: cli.replay.run → logbook.replay.replay → jobs.replay.repeat_run → logbook.replay.compare_events
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli import compare as comparing
from fdi_torch.cli.screen import Screen
from fdi_torch.logbook import Replay, read_run, replay
from fdi_torch.logbook.replay import RELATIVE

DIFFERS = 3


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    return what_if(arguments, screen) if arguments.set else faithful(arguments, screen)


def faithful(arguments: argparse.Namespace, screen: Screen) -> int:
    """Repeat the run unchanged; every event must be the same."""
    from fdi_torch.jobs.replay import comparable, repeat_run

    with tempfile.TemporaryDirectory() as folder, screen.progress("replay") as advance:
        target = Path(arguments.out or Path(folder) / "again.mcap")
        done = replay(
            arguments.log,
            lambda log: repeat_run(log, target, (), arguments.trial, advance),
            select=comparable(arguments.trial),
        )
        advance(1.0, "done")
    for line in in_words(done):
        screen.say(line)
    screen.result({"format": "fdi_torch.replay/1", "replay": done})
    return DIFFERS if done.outcome == "differs" else DONE


def what_if(arguments: argparse.Namespace, screen: Screen) -> int:
    """Repeat the run with another setting, and compare the new log with the old one."""
    from fdi_torch.jobs.replay import repeat_run
    from fdi_torch.jobs.report import compare

    source = Path(arguments.log)
    target = Path(arguments.out or source.with_name(f"{source.name.removesuffix('.mcap')}.what_if.mcap"))
    with screen.progress("replay") as advance:
        repeat_run(read_run(source), target, arguments.set, arguments.trial, advance)
        advance(1.0, "done")
    compared = compare([source, target])
    for label, verdict in compared.verdicts.items():
        screen.say(f"{label}: {verdict.removesuffix('.')}.")
    comparing.show(compared, screen)
    screen.say(f"log: {target}")
    words = {"verdicts": compared.verdicts, "comparison": compared.comparison}
    screen.result({"format": "fdi_torch.replay/1", "log": str(target), **words})
    return DONE


def in_words(done: Replay) -> list[str]:
    """Lines with the outcome and the first difference."""
    lines = [f"{done.outcome}: {done.events} events compared, largest relative difference {done.largest:.3g}"]
    if done.outcome == "within tolerance":
        lines[0] += f" of {RELATIVE:g}"
    for title, difference in (("beyond the tolerance", done.first), ("not bit-equal", done.first_inexact)):
        if difference is not None:
            where = f"event {difference.event}, {difference.topic} at {difference.place}, {difference.field}"
            lines.append(f"first {title}: {where}: {difference.logged} became {difference.replayed}")
    lines += [f"{name} was {then or 'absent'}, is {now or 'absent'}" for name, (then, now) in done.versions.items()]
    return lines
