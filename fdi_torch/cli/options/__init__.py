"""The options of each command, one module per command, and options that several commands share.

A module has the description of its command (the docstring), EXAMPLES, and ARGUMENTS, for `add_argument` by their names.
None of them imports torch, so that help is shown immediately.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fdi_torch.cli.screen import Screen
    from fdi_torch.logbook import Listener

LIVE = "127.0.0.1:8765"
Arguments = dict[str, dict[str, Any]]
RECORDING = "a recording (CSV, Excel, Parquet, Feather, MATLAB, HDF5 or MCAP), or a YAML file with `recordings`"


class ShowKeys(argparse.Action):
    """Print the keys of a file and exit. models: 'module:Model', imported only when needed."""

    def __init__(self, models: Sequence[str], **settings: Any) -> None:
        super().__init__(nargs=0, **settings)
        self.models = models

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from fdi_torch.cli import defer_torch

        defer_torch()
        from fdi_torch.config.key_reference import config_reference

        for model in self.models:
            module, name = model.split(":")
            sys.stdout.write(config_reference(getattr(import_module(module), name)) + "\n")
        parser.exit()


def keys(what: str, *models: str) -> Arguments:
    """--keys, which prints the keys of a file. models: its models as 'module:Model'."""
    text = f"print every key of {what} with its default and meaning, and exit"
    return {"--keys": {"action": ShowKeys, "models": models, "help": text}}


def config(
    *models: str, required: bool = False, kind: str = "run", example: str = "estimate.search.population=40"
) -> Arguments:
    """--config and --set. models: models of the file as 'module:Model'. kind: of the file. example: of --set."""
    change = f"change one value of the file, as in --set {example}; may be repeated"
    return {
        "--config": {"metavar": "FILE", "required": required, "help": f"{kind} file (YAML)"},
        **(keys("such a file", *models) if models else {}),
        "--set": {"metavar": "KEY=VALUE", "action": "append", "default": [], "help": change},
    }


def seconds(text: str) -> float:
    """A time on the command line: '90 s', '1.5 h', or a bare number of seconds."""
    try:
        return float(text)
    except ValueError:
        pass
    from fdi_torch.units import UnitError, in_unit, number_and_unit

    try:
        return in_unit(*number_and_unit(text), "s")
    except UnitError:
        raise argparse.ArgumentTypeError(f"expected a time such as 90 or '1.5 h', got '{text}'") from None


def names(text: str | None) -> tuple[str, ...]:
    """The names in a list with commas."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


def overrides(arguments: argparse.Namespace) -> list[str]:
    """--set and its short forms as overrides; later ones win."""
    short = {"output.folder": "out", "device": "device", "seed": "seed", "source.url": "source"}
    given = [(key, getattr(arguments, name, None)) for key, name in short.items()]
    return [*arguments.set, *(f"{key}={value}" for key, value in given if value is not None)]


START_SAMPLES = 50
_NAMES = {"type": names, "default": ()}
_SHARED: Arguments = {
    "--plant": {"metavar": "NAME|FILE", "help": "a shipped plant, or a plant file"},
    "--recording": {"metavar": "FILE", "help": RECORDING},
    "--holdout": {
        "metavar": "FILE",
        "nargs": "+",
        "default": [],
        "help": "other recordings of the same rig, for validation only",
    },
    "--library": _NAMES | {"metavar": "EFFECT,...", "help": "effects to search (PLACE.EFFECT at one place), or all"},
    "--leave-out": _NAMES | {"metavar": "EFFECT,...", "help": "effects to leave out of the library"},
    "--vary": _NAMES | {"metavar": "NAME,..."},
    "--step": {"metavar": "TIME", "type": seconds},
    "--noise": {
        "metavar": "AMOUNT",
        "default": "1 mm",
        "help": "standard deviation of the readings: as a level (1 mm), or 'h1 = 1 mm, p2 = 2 mV'",
    },
    "--start-samples": {
        "metavar": "N",
        "type": int,
        "default": START_SAMPLES,
        "help": f"samples of each free run for its initial levels ({START_SAMPLES})",
    },
    "--settle": {
        "metavar": "TIME",
        "type": seconds,
        "help": "instead, estimate levels and what varies by run from the first part of each free run ('30 s'), and "
        "count errors after it",
    },
    "--adopt": {"metavar": "FILE"},
    "--replace": {"action": "store_true", "help": "--adopt overwrites a file that exists"},
    "--narrow": {"action": "store_true"},
    "--out": {
        "metavar": "DIR",
        "help": "output folder (default: logs); a file that exists is kept, and the new one is NAME_2, NAME_3 ...",
    },
    "--seed": {"metavar": "N", "type": int, "help": "seed of all random numbers"},
    "--device": {
        "metavar": "cpu|cuda",
        "help": "of the estimation (cpu; cuda gives the same results, and is faster only above 250,000 candidates at "
        "once)",
    },
    "--resume": {"action": "store_true", "help": "continue a stopped run of the same file from its log"},
    "--cluster": {
        "metavar": "local|ADDRESS",
        "help": "run on Dask: local, or tcp://host:8786 or tls://host:8786; it must be trusted, for it runs code here",
    },
    "--live": {
        "metavar": "[HOST:]PORT",
        "nargs": "?",
        "const": LIVE,
        "help": f"stream the running job to Foxglove or Lichtblick (without a value: {LIVE}, reachable from this "
        "machine only; 0.0.0.0:PORT opens it to the whole network without a password; needs the extra `live`)",
    },
}
"""Options of several commands."""


def shared(*options: str, **changes: Any) -> Arguments:
    """Options of several commands. changes: arguments of `add_argument` in which they differ in this command."""
    return {option: _SHARED[option] | changes for option in options}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    for names_of, settings in import_module(f"{__name__}.{command}").ARGUMENTS.items():
        parser.add_argument(*names_of.split(), **settings)


def host_and_port(option: str, address: str, example: str) -> tuple[str, int]:
    """The parts of [HOST:]PORT; without a host, that of the example. Raises ValueError for anything else."""
    host, _, port = address.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) < 2**16):
        raise ValueError(f"{option}: expected [HOST:]PORT such as {example}, got {address}")
    return host or example.partition(":")[0], int(port)


def access_text(host: str) -> str:
    """Who can read the stream; the server has no password."""
    if host.strip("[]") in ("127.0.0.1", "::1", "localhost"):
        return "only users of this machine can read it"
    return "everybody who reaches this machine can read it, without a password"


@contextmanager
def live(arguments: argparse.Namespace, name: str, screen: Screen) -> Iterator[Listener | None]:
    """The server that --live asks for, which streams the log; None without --live."""
    if arguments.live is None:
        yield None
        return
    from fdi_torch.logbook import serve

    host, port = host_and_port("--live", arguments.live, LIVE)
    with serve(name, host, port) as server:
        screen.note(f"live: {server.address} ({access_text(host)})")
        yield server
