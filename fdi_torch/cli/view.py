"""`fdi view`: what it does and prints. Its options: `options/view.py`.

Path: cli.view.run → view.server.bound → view.server.application
"""

from __future__ import annotations

import argparse
import shutil
import sys
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.interruption import Terminated
from fdi_torch.report.html import short
from fdi_torch.tables import Table
from fdi_torch.view.log_list import SORTS, LogList, selected

LEAST_VERDICT, PIPED_VERDICT = 24, 100  # letters; a narrower terminal folds the row, a pipe has no width


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
    rows, header = [entry.cells for entry in entries], [*SORTS.values()]
    if rows:
        screen.show(Table(header, _fitting(header, rows), words=len(header)))
    else:
        screen.say(f"no log matches '{words}'" if words else f"no log in {folder}")
    screen.result({"format": "fdi_torch.view_list/1", "logs": [dict(zip(SORTS, row, strict=True)) for row in rows]})


def _fitting(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """The rows with verdicts cut to what the terminal leaves them, to `PIPED_VERDICT` where there is none."""
    if not sys.stdout.isatty():
        return [[*row[:-1], short(row[-1], PIPED_VERDICT)] for row in rows]
    taken = sum(2 + max(map(len, column)) for column in zip(header[:-1], *(row[:-1] for row in rows), strict=True))
    most = max(shutil.get_terminal_size().columns - taken, LEAST_VERDICT)
    return [[*row[:-1], short(row[-1], most)] for row in rows]
