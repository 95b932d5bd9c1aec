"""`fdi recover`: what it does and prints. Its options: `options/recover.py`.

Path: cli.recover.run → logbook.recover.recover
"""

from __future__ import annotations

import argparse

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.logbook import recover

LOST = 3


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    done = recover(arguments.log, arguments.out)
    screen.say(done.sentence)
    for damage in done.lost:
        screen.say(f"- bytes {damage.start} to {damage.end}: {damage.reason}")
    screen.result(
        {
            "format": "fdi_torch.recover/1",
            "source": str(done.source),
            "target": str(done.target),
            "messages": done.messages,
            "ended": done.ended,
            "lost": [{"from": d.start, "to": d.end, "reason": d.reason} for d in done.lost],
        }
    )
    return DONE if done.whole else LOST
