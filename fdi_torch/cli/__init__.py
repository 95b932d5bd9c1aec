"""`fdi COMMAND`: parse the command line, run the command, and turn errors into a message and an exit code.

Exit codes: 0 done, 2 wrong use (explained on standard error), 3 ran but did not converge, 4 converged, but the
model does not explain the recording, 130 interrupted, 143 terminated.
A command is a module `options/NAME.py` with its description, its STEP and SUMMARY in the overview, EXAMPLES,
ARGUMENTS and, if it takes more than a moment to start, LONG = True, or, if it usually computes nothing,
QUICK = True; and a module `NAME.py` with `run(arguments, screen) -> exit code`. The latter is imported after the
arguments are parsed, so that help does not wait for torch, and a QUICK command loads torch when it first uses it.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from contextvars import copy_context
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Any, NoReturn

from fdi_torch.cli.options import add_arguments, seconds
from fdi_torch.disk import sentence
from fdi_torch.interruption import Terminated, catch_signals
from fdi_torch.names import nearest, unknown

DONE, MISUSE, NOT_CONVERGED, NOT_EXPLAINED, INTERRUPTED, TERMINATED = 0, 2, 3, 4, 130, 143

COMMANDS = tuple(sorted(module.name for module in iter_modules([str(Path(__file__).with_name("options"))])))
TIME_UNITS = ("ms", "s", "min", "h", "d")
NUMBER = re.compile(r"[+-]?\d+(\.\d*)?")
STEPS = {
    "describe": "Describe a rig and its recordings",
    "diagnose": "Diagnose a recording",
    "monitor": "Monitor a running plant",
    "plan": "Plan an experiment",
    "look": "Look at logs",
    "validate": "Validate the methods",
    "use": "Use elsewhere",
}
"""Headings of the list of commands that `fdi` prints, in order, by key. The constant `STEP` of each file in
`cli/options` is the key of the heading under which its command is listed.
"""


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
    """The entry point `fdi`. Standard output may be closed early, as by `| head`, or from the start."""
    _open_standard_streams()
    # torch compiles its own rules of differentiation so, and its users cannot do anything about it.
    warnings.filterwarnings("ignore", r"`torch\.jit\.script` is deprecated", FutureWarning)
    code = DONE
    try:
        code = main()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        sys.stderr.write(f"fdi: {sentence('standard output', error)}\n")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = MISUSE
    sys.exit(code)


def _open_standard_streams() -> None:
    """Open closed standard streams (`>&-`), so that no file opened later gets their numbers and the printed text."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115


def _overview() -> str:
    lines = ["usage: fdi COMMAND [options]", "       fdi --version", ""]
    listed = {name: options_of(name) for name in COMMANDS}
    for step, title in STEPS.items():
        lines += [f"{title}:", *(f"  {n:<16}{o.SUMMARY}" for n, o in listed.items() if step == o.STEP), ""]
    return "\n".join([*lines, "fdi COMMAND --help describes a command and shows examples.", ""])


def _run(name: str, words: list[str]) -> int:
    try:
        catch_signals()
        return copy_context().run(_carried_out, name, words)  # its units for display end with it
    except (KeyboardInterrupt, Terminated) as error:  # also while libraries load
        sys.stderr.write(f"fdi {name}: {ending(error)}\n")
        return TERMINATED if isinstance(error, Terminated) else INTERRUPTED


def ending(error: KeyboardInterrupt | Terminated) -> str:
    """Message about an interrupted job, with the log's notes on how to resume it."""
    notes = getattr(error, "__notes__", ()) or ("the same command starts again from the beginning",)
    return "; ".join(["terminated" if isinstance(error, Terminated) else "interrupted", *notes])


def _carried_out(name: str, words: list[str]) -> int:
    arguments = command_parser(name).parse_args(words)
    if getattr(options_of(name), "QUICK", False):
        defer_torch()
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
        for problem in getattr(error, "problems", [str(error)]):
            screen.complain(f"fdi {name}: {problem}")
        return MISUSE
    except (MemoryError, RuntimeError) as error:
        sentence = _resource_problem(error)
        if arguments.traceback or not sentence:
            raise
        screen.complain(f"fdi {name}: {sentence}")
        return MISUSE


def _resource_problem(error: Exception) -> str:
    """Message about a lack of memory or a singular problem; empty for other errors."""
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return "the run needs more memory than this machine has; shorten it, or lower population"
    if "LinAlgError" in type(error).__name__:
        return (
            "expected readings that determine the result, got a singular matrix: channels that are constant, identical "
            "or without noise; fdi check shows which"
        )
    return ""


def defer_torch() -> None:
    """Let `import torch` load it when it is first used."""
    sys.modules.setdefault("torch", _Deferred("torch"))


class _Deferred(ModuleType):
    """Stands for a library in `sys.modules` until an attribute of it is used, and loads it then.

    `importlib.util.LazyLoader` does not serve: a second `import` of the library loads it.
    """

    def __getattr__(self, attribute: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        library = importlib.import_module(self.__name__)
        vars(self).update(vars(library))
        return getattr(library, attribute)


def _say_that_it_began(name: str, quiet: bool) -> None:
    """Announce the start of a job before its libraries load, which takes seconds."""
    if getattr(options_of(name), "LONG", False) and "torch" not in sys.modules and not quiet:
        with suppress(BrokenPipeError):
            sys.stderr.write(f"fdi {name}: loading\n")
            sys.stderr.flush()


class _Parser(argparse.ArgumentParser):
    """A parser that names the option for a file without one, and the nearest one of an unknown option."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.register("type", int, _whole_number)

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        options = [word.partition("=")[0] for word in args if word.startswith("--") and len(word) > 2]
        for option in options:  # before an argument is missed that it was meant to be
            if option not in self._option_string_actions:
                self.error(f"unrecognized argument: {option}{self._instead(option)}")
        self._expect_quoted_units(args)
        known, others = super().parse_known_args(args, namespace)
        file = others[0] if others else ""
        option = "--config" if Path(file).suffix in (".yaml", ".yml") else "--recording"
        if Path(file).suffix and option in self._option_string_actions:
            self.error(f"unrecognized argument: {file}; name a file by its option: {option} {file}")
        if Path(file).suffix and "--config" in self._option_string_actions:
            self.error(f"unrecognized argument: {file}; name it in the file for --config (fdi new writes one)")
        return known, others

    def _expect_quoted_units(self, words: Sequence[str]) -> None:
        """Error for a unit that the shell has cut off a time, before it counts as the name of a recording."""
        for option, value, unit in zip(words, words[1:], words[2:], strict=False):
            action = self._option_string_actions.get(option)
            if action and action.type is seconds and NUMBER.fullmatch(value) and unit in TIME_UNITS:
                self.error(f"unrecognized argument: {unit}; quote a time with its unit: {option} '{value} {unit}'")

    def error(self, message: str) -> NoReturn:
        lacks_file = message.endswith("required: --config")
        super().error(f"{message}; fdi new {self._kind} writes such a file" if lacks_file else message)

    @property
    def _kind(self) -> str:
        """The kind of file that this command reads by --config."""
        command = self.prog.rpartition(" ")[2]
        return {"rehearse": "rehearsal"}.get(command, command if command in ("monitor", "study") else "run")

    def _instead(self, option: str) -> str:
        """What this command takes in place of an option that others have."""
        known = self._option_string_actions
        if option in ("--plant", "--recording") and "--config" in known:
            return f"; name it in the file for --config, which fdi new {self._kind} {option} ... writes"
        if option == "--config" and "--plant" in known and "--recording" in known:
            return "; name --plant and --recording, whose YAML file may list several"
        return nearest(option, known)


def _whole_number(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got '{text}'") from None


def options_of(name: str) -> ModuleType:
    return importlib.import_module(f"fdi_torch.cli.options.{name}")


def command_parser(name: str) -> argparse.ArgumentParser:
    options = options_of(name)
    parser = _Parser(
        prog=f"fdi {name}",
        description=options.__doc__,
        epilog=options.EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_arguments(parser, name)
    parser.add_argument("--json", action="store_true", help="print JSON and nothing else on standard output")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    parser.add_argument(
        "--traceback", action="store_true", help="print the Python traceback of an error instead of its message"
    )
    return parser
