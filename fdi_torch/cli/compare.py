"""`fdi compare`: what it does and prints. Its options: `options/compare.py`."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.disk import replacing
from fdi_torch.logbook import Comparison, compare, read_run
from fdi_torch.report.comparison import comparison_section, in_words, result_rows
from fdi_torch.report.material import gather
from fdi_torch.report.style import save

MOST_TEXT = 40


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    comparison = compare(arguments.logs)
    show(comparison, screen)
    if arguments.csv:
        with replacing(Path(arguments.csv)) as new, new.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(comparison.rows())
        screen.say(f"table: {arguments.csv}")
    if arguments.pictures:
        section = comparison_section(comparison, [gather(read_run(name)) for name in arguments.logs])
        for picture in section.pictures:
            for ending in (".png", ".svg"):
                save(picture.figure, Path(arguments.pictures) / f"{picture.name}{ending}")
        screen.say(f"{len(section.pictures)} pictures: {arguments.pictures}")
    screen.result({"format": "fdi_torch.compare/1", "comparison": comparison})
    return DONE


def show(comparison: Comparison, screen: Screen) -> None:
    for sentence in in_words(comparison):
        screen.say(sentence)
    for section, entries in comparison.differences.items():
        rows = [[key, *(text[:MOST_TEXT] for text in texts)] for key, texts in entries.items()]
        screen.say()
        screen.table(section, ("key", *comparison.labels), rows, left=1 + len(comparison.labels))
    if comparison.results:
        screen.say()
        screen.table(
            "estimates", ("parameter", "unit", *comparison.labels, "p", "agree"), result_rows(comparison), left=2
        )
