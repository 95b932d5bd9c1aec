"""`fdi compare`: what it does and prints. Its options: `options/compare.py`.

Path: cli.compare.run → jobs.report.compare → logbook.compare.compare →
report.comparison_headline.comparison_headline
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.disk import replacing
from fdi_torch.jobs.report import ComparisonResult, compare
from fdi_torch.report.page import write_pictures


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    compared = compare(arguments.logs)
    show(compared, screen)
    if arguments.csv:
        with replacing(Path(arguments.csv)) as new, new.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(compared.comparison.rows())
        screen.say(f"table: {arguments.csv}")
    if arguments.pictures:
        pictures = compared.pictures
        write_pictures(pictures, Path(arguments.pictures))
        screen.say(f"{len(pictures)} pictures: {arguments.pictures}")
    words = {"comparison": compared.comparison, "headline": compared.sentences}
    screen.result({"format": "fdi_torch.compare/1", **words})
    return DONE


def show(compared: ComparisonResult, screen: Screen) -> None:
    """Print the comparison in the units of the first run."""
    for sentence in compared.sentences:
        screen.say(sentence)
    for table in compared.tables():
        screen.say()
        screen.show(table)
