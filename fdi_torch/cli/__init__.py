"""`fdi COMMAND`: finds the command, runs it, and turns what goes wrong into one sentence and an exit code.

Exit codes: 0 done, 2 misuse (said in one sentence on standard error), 3 ran but did not converge, 130 interrupted,
143 terminated.
A command is one line of `COMMANDS`, a module `options/NAME.py` with its description, EXAMPLES and
`add_arguments(parser)`, and a module `NAME.py` with `run(arguments, screen) -> exit code`. The latter is imported only
once the arguments are read, so that help does not wait for torch.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from types import ModuleType
from typing import NoReturn

from fdi_torch.disk import sentence
from fdi_torch.interruption import Terminated, catch_signals
from fdi_torch.names import unknown

DONE, MISUSE, NOT_CONVERGED, INTERRUPTED, TERMINATED = 0, 2, 3, 130, 143

COMMANDS = {
    "train": "estimate the faults in a recording, and log how",
    "simulate": "write a recording from a plant, inputs, faults and noise",
    "check": "examine a plant and a recording before any fit",
    "effects": "the catalogue of faults and unmodelled effects, and how each is written",
    "new": "write a commented minimal file: a plant, run, monitor or study",
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
    "challenge": "blind benchmark: the gap diagnosis on hidden rigs whose causes are sealed",
    "study": "many trials at once: errors against their bounds, coverage, failures",
    "paper": "make the 2020 paper's tables and figures again",
}

LONG = ("train", "study", "gap", "monitor", "challenge", "paper")
"""Commands that work for more than a moment, and say so at once."""


def main(argv: Sequence[str] | None = None) -> int:
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        sys.stdout.write(_overview())
        return DONE if words else MISUSE
    if words[0] == "--version":
        from importlib.metadata import version

        sys.stdout.write(f"fdi_torch {version('fdi_torch')}\n")
        return DONE
    if words[0] not in COMMANDS:
        sys.stderr.write(f"fdi: {unknown('a command', words[0], COMMANDS)}\n")
        return MISUSE
    return _run(words[0], words[1:])


def command_line() -> NoReturn:
    """The entry point `fdi`. Who reads may stop reading, as `| head` does, or never have begun."""
    _open_standard_streams()
    try:
        code = main()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = DONE
    except OSError as error:
        sys.stderr.write(f"fdi: {sentence('standard output', error)}\n")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = MISUSE
    sys.exit(code)


def _open_standard_streams() -> None:
    """Where one was closed (`>&-`), nothing that is opened later may take its number and hear what is printed."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115


def _overview() -> str:
    lines = [f"  {name:<16}{what}" for name, what in COMMANDS.items()]
    ending = "fdi COMMAND --help tells more, and ends in examples."
    return "\n".join(["usage: fdi COMMAND [options]", "       fdi --version", "", *lines, "", ending, ""])


def _run(name: str, words: list[str]) -> int:
    try:
        catch_signals()
        return _carried_out(name, words)
    except (KeyboardInterrupt, Terminated) as error:  # also while libraries load
        sys.stderr.write(f"fdi {name}: {ending(error)}\n")
        return TERMINATED if isinstance(error, Terminated) else INTERRUPTED


def ending(error: KeyboardInterrupt | Terminated) -> str:
    """What is left of a job that was interrupted, and how it goes on: as its log says, if it had begun one."""
    notes = getattr(error, "__notes__", ()) or ("the same command starts anew",)
    return "; ".join(["terminated" if isinstance(error, Terminated) else "interrupted", *notes])


def _carried_out(name: str, words: list[str]) -> int:
    options = importlib.import_module(f"fdi_torch.cli.options.{name}")
    arguments = _parser(name, options).parse_args(words)
    _say_that_it_began(name, arguments.quiet)
    command = importlib.import_module(f"fdi_torch.cli.{name}")
    from fdi_torch.cli.screen import Screen

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
    except (MemoryError, RuntimeError) as error:
        sentence = _of_the_machine(error)
        if arguments.traceback or not sentence:
            raise
        screen.complain(f"fdi {name}: {sentence}")
        return MISUSE


def _of_the_machine(error: Exception) -> str:
    """What to say of memory that is not there and of numbers that determine nothing; nothing of other errors."""
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return "expected less work than this machine has memory for, got more; shorten the run, or lower population"
    if "LinAlgError" in type(error).__name__:
        return (
            "expected readings that determine the result, got a singular matrix: channels that are constant, alike or "
            "without noise; fdi check tells which"
        )
    return ""


def _say_that_it_began(name: str, quiet: bool) -> None:
    """A job's libraries take seconds to load where they are not there yet: its first sign of life comes before them."""
    if name in LONG and "torch" not in sys.modules and not quiet:
        with suppress(BrokenPipeError):
            sys.stderr.write(f"fdi {name}: loading\n")
            sys.stderr.flush()


def _parser(name: str, options: ModuleType) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"fdi {name}",
        description=options.__doc__,
        epilog=options.EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    options.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON and nothing else on standard output")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    parser.add_argument(
        "--traceback", action="store_true", help="where a sentence would be printed, show the code's path"
    )
    return parser
