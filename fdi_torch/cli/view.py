"""`fdi view`: what it does and prints. Its options: `options/view.py`.

Path: cli.view.run → view.server.bound → view.server.application
"""

from __future__ import annotations

import argparse
import webbrowser
from contextlib import suppress
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.interruption import Terminated
from fdi_torch.view.log_list import LogList, selected


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    if arguments.list is not None:
        _print_list(Path(arguments.folder), arguments.list, screen)
        return DONE
    from fdi_torch.view.server import bound

    with bound(Path(arguments.folder), arguments.port) as (address, serve):
        with suppress(KeyboardInterrupt, Terminated):  # the usual ends
            screen.say(f"folder {arguments.folder}: {address} (only users of this machine can read it)")
            screen.note("Ctrl-C ends it")
            screen.result({"format": "fdi_torch.view/1", "address": address})
            if arguments.open:
                webbrowser.open(address)
            serve()
        screen.note("ended")
    return DONE


def _print_list(folder: Path, words: str, screen: Screen) -> None:
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of logs, got none")
    entries = selected(LogList(folder).entries(), words)
    rows = [[e.name, e.started, e.kind, e.state, e.error_text, e.verdict] for e in entries]
    header = ("log", "started, UTC", "kind", "state", "error", "verdict")
    screen.table("", header, rows, left=len(header))
    if not rows:
        screen.say("no log" + (f" with the words '{words}'" if words else f" in {folder}"))
    names = ("log", "started", "kind", "state", "error", "verdict")
    screen.result({"format": "fdi_torch.view_list/1", "logs": [dict(zip(names, row, strict=True)) for row in rows]})
