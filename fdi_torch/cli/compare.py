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
    compared = compare(arguments.logs)
    show(compared, screen)
    if arguments.csv:
        with replacing(Path(arguments.csv)) as new, new.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(compared.rows())
        screen.say(f"table: {arguments.csv}")
    if arguments.pictures:
        section = comparison_section(compared, [gather(read_run(name)) for name in arguments.logs])
        for picture in section.pictures:
            for ending in (".png", ".svg"):
                save(picture.figure, Path(arguments.pictures) / f"{picture.name}{ending}")
        screen.say(f"{len(section.pictures)} pictures: {arguments.pictures}")
    screen.result({"format": "fdi_torch.compare/1", "comparison": compared})
    return DONE


def show(compared: Comparison, screen: Screen) -> None:
    for sentence in in_words(compared):
        screen.say(sentence)
    for section, entries in compared.differences.items():
        rows = [[key, *(text[:MOST_TEXT] for text in texts)] for key, texts in entries.items()]
        screen.say()
        screen.table(section, ("key", *compared.labels), rows, left=1 + len(compared.labels))
    if compared.results:
        screen.say()
        screen.table("estimates", ("parameter", "unit", *compared.labels, "p", "agree"), result_rows(compared), left=2)
