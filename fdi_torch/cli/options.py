"""Options that several commands have in one form."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from fdi_torch.cli.screen import Screen
from fdi_torch.config.reference import config_reference
from fdi_torch.config.strict import Strict
from fdi_torch.logbook import Listener, serve
from fdi_torch.parameters import parse_quantity

LIVE = "127.0.0.1:8765"


class ShowKeys(argparse.Action):
    """Prints what may stand in a file, and ends."""

    def __init__(self, models: Sequence[type[Strict]], **settings: Any) -> None:
        super().__init__(nargs=0, **settings)
        self.models = models

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        for model in self.models:
            sys.stdout.write(config_reference(model) + "\n")
        parser.exit()


def add_keys(parser: argparse.ArgumentParser, what: str, *models: type[Strict]) -> None:
    told = f"print every key of {what} with its default and meaning, and end"
    parser.add_argument("--keys", action=ShowKeys, models=models, help=told)


def add_config(parser: argparse.ArgumentParser, *models: type[Strict], required: bool = False) -> None:
    """models: of what may stand in the file."""
    parser.add_argument("--config", metavar="FILE", required=required, help="run file (YAML)")
    if models:
        add_keys(parser, "such a file", *models)
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="change one value of it, as in --set estimate.search.population=40; may be repeated",
    )


def seconds(text: str) -> float:
    """A time on the command line: '90 s', '1.5 h', or a bare number of seconds."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return parse_quantity(text, "s")
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a time such as 90 or '1.5 h', got '{text}'") from None


def add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", help="folder for what is written (default: logs)")
    parser.add_argument("--device", metavar="cpu|cuda", help="where tensors live")
    parser.add_argument("--seed", metavar="N", type=int, help="of everything drawn at random")


def overrides(arguments: argparse.Namespace) -> list[str]:
    """--set, and the short forms of what it can set, last ones winning."""
    short = {"output.folder": "out", "device": "device", "seed": "seed"}
    given = [(key, getattr(arguments, name, None)) for key, name in short.items()]
    return [*arguments.set, *(f"{key}={value}" for key, value in given if value is not None)]


def add_live(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--live",
        metavar="[HOST:]PORT",
        nargs="?",
        const=LIVE,
        help=f"serve the running job to Foxglove or Lichtblick (alone: {LIVE}; needs the extra live)",
    )


@contextmanager
def live(arguments: argparse.Namespace, name: str, screen: Screen) -> Iterator[Listener | None]:
    """What --live asks for: a server that hears the log, whose address is told; None without --live."""
    if arguments.live is None:
        yield None
        return
    host, _, port = arguments.live.rpartition(":")
    if not (port.isdigit() and int(port) < 2**16):
        raise ValueError(f"--live: expected [HOST:]PORT such as {LIVE}, got {arguments.live}")
    with serve(name, host or LIVE.partition(":")[0], int(port)) as server:
        screen.note(f"live: {server.address}")
        yield server
