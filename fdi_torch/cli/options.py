"""Options that several commands have in one form."""

from __future__ import annotations

import argparse


def add_config(parser: argparse.ArgumentParser, required: bool = False) -> None:
    parser.add_argument("--config", metavar="FILE", required=required, help="run file (YAML)")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="change one value of it, as in --set estimate.search.population=40; may be repeated",
    )


def add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", help="folder for the log and the pictures (default: logs)")
    parser.add_argument("--device", metavar="cpu|cuda", help="where tensors live")
    parser.add_argument("--seed", metavar="N", type=int, help="of everything drawn at random")


def overrides(arguments: argparse.Namespace) -> list[str]:
    """--set, and the short forms of what it can set, last ones winning."""
    short = {"output.folder": "out", "device": "device", "seed": "seed"}
    given = [(key, getattr(arguments, name, None)) for key, name in short.items()]
    return [*arguments.set, *(f"{key}={value}" for key, value in given if value is not None)]
