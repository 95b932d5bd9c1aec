"""`fdi completion`: what it prints. Its options: `options/completion.py`.

Path: cli.completion.run → cli.command_parser
"""

from __future__ import annotations

import argparse

from fdi_torch.cli import COMMANDS, DONE, command_parser, options_of
from fdi_torch.cli.screen import Screen
from fdi_torch.tables import needed


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    shtab = needed("shtab", "completion")
    whole = argparse.ArgumentParser("fdi", allow_abbrev=False)
    commands = whole.add_subparsers(metavar="COMMAND")
    for name in COMMANDS:
        parser = command_parser(name)
        for action in parser._actions:
            words = str(action.metavar or "").split("|")
            if "FILE" in words or "DIR" in words:
                action.complete = shtab.FILE if "FILE" in words else shtab.DIRECTORY  # type: ignore[attr-defined]
        commands.add_parser(name, help=options_of(name).SUMMARY)
        commands.choices[name] = parser
    script = shtab.complete(whole, shell=arguments.shell)
    screen.say(script)
    screen.result({"format": "fdi_torch.completion/1", "shell": arguments.shell, "script": script})
    return DONE
