"""`fdi COMMAND`: finds the command, runs it, and turns what goes wrong into one sentence and an exit code.

Exit codes: 0 done, 2 misuse (said in one sentence on standard error), 3 ran but did not converge, 130 interrupted.
A command is a module here with HELP, `add_arguments(parser)` and `run(arguments, screen) -> exit code`; it is imported
only when asked for, so that help is instant.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from fdi_torch.names import unknown

DONE, MISUSE, NOT_CONVERGED, INTERRUPTED = 0, 2, 3, 130

COMMANDS = {
    "train": "estimate the faults in a recording, and log how",
    "simulate": "write a recording from a plant, inputs, faults and noise",
    "check": "examine a plant and a recording before any fit",
    "monitor": "follow a recording: alarms, faults with their onset and size, recoveries",
    "diagnosability": "what an experiment can tell: which faults show, which can be told apart",
    "rehearse": "try a monitor out on simulated runs: false alarms, delays, names, rivals",
    "report": "make one HTML page of one or more logs",
    "inspect": "what a log is about, whether it is sound, and its messages for other tools",
    "replay": "run a logged estimation or study again and compare, or try what another choice gives",
    "compare": "what differs between runs, and whether their results agree",
    "recover": "save what is whole of a broken or unfinished log",
    "gap": "where a plant file falls short of a recording, by which effect, and how far the gap closes",
    "predict": "run a plant freely along a recording, and how far off it gets",
    "challenge": "check the gap diagnosis on hidden rigs whose causes are sealed",
    "study": "many trials at once: errors against their bounds, coverage, failures",
    "paper": "make the 2020 paper's tables and figures again",
}

LONG = ("train", "study", "gap", "monitor", "challenge", "paper")
"""Commands that work for more than a moment, and say so at once."""

_LOGGED = "; what was computed until now is in its log"
KEPT = dict.fromkeys(("train", "study", "rehearse"), f"{_LOGGED}, and --resume goes on from there")
KEPT |= dict.fromkeys(("monitor", "challenge"), _LOGGED)
"""Of commands that log as they go, what is left of one that was interrupted; the others write at their end."""


def main(argv: Sequence[str] | None = None) -> int:
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        sys.stdout.write(_overview())
        return DONE if words else MISUSE
    if words[0] not in COMMANDS:
        sys.stderr.write(f"fdi: {unknown('a command', words[0], COMMANDS)}\n")
        return MISUSE
    return _run(words[0], words[1:])


def command_line() -> NoReturn:
    """The entry point `fdi`. Who reads may stop reading, as `| head` does."""
    try:
        code = main()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = DONE
    sys.exit(code)


def _overview() -> str:
    lines = [f"  {name:<16}{what}" for name, what in COMMANDS.items()]
    return "\n".join(["usage: fdi COMMAND [options]", "", *lines, "", "fdi COMMAND --help tells more.", ""])


def _run(name: str, words: list[str]) -> int:
    try:
        return _carried_out(name, words)
    except KeyboardInterrupt:  # also while libraries load
        sys.stderr.write(f"fdi {name}: interrupted{KEPT.get(name, '')}\n")
        return INTERRUPTED


def _carried_out(name: str, words: list[str]) -> int:
    _say_that_it_began(name, words)
    command = importlib.import_module(f"fdi_torch.cli.{name}")
    arguments = _parser(name, command).parse_args(words)
    from fdi_torch.cli.screen import Screen
    from fdi_torch.logbook import exit_on_sigterm

    # An open log is then finished like any other.
    exit_on_sigterm()
    screen = Screen(json=arguments.json, quiet=arguments.quiet)
    try:
        return int(command.run(arguments, screen))
    except BrokenPipeError:
        raise
    except (ValueError, OSError) as error:
        if arguments.traceback:
            raise
        for line in str(error).splitlines():
            screen.complain(f"fdi {name}: {line}")
        return MISUSE


def _say_that_it_began(name: str, words: Sequence[str]) -> None:
    """A job's libraries take seconds to load where they are not there yet: its first sign of life comes before them."""
    if name in LONG and "torch" not in sys.modules and not {"-h", "--help", "--keys", "--quiet"} & set(words):
        sys.stderr.write(f"fdi {name}: loading\n")
        sys.stderr.flush()


def _parser(name: str, command: ModuleType) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=f"fdi {name}", description=command.__doc__, allow_abbrev=False)
    command.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON and nothing else on standard output")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    parser.add_argument(
        "--traceback", action="store_true", help="where a sentence would be printed, show the code's path"
    )
    return parser
