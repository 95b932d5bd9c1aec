"""`fdi view`: what it does and prints. Its options: `options/view.py`."""

from __future__ import annotations

import argparse
import webbrowser
from contextlib import suppress
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.view.server import bound


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    with bound(Path(arguments.folder), arguments.port) as (address, serve):
        screen.say(f"logs of {arguments.folder}: {address} (only users of this machine can read it)")
        screen.note("Ctrl-C ends it")
        screen.result({"format": "fdi_torch.view/1", "address": address})
        if arguments.open:
            webbrowser.open(address)
        with suppress(KeyboardInterrupt):  # the usual end
            serve()
        screen.note("ended")
    return DONE
