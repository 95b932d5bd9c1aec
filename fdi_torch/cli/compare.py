"""`fdi compare`: what it does and prints. Its options: `options/compare.py`.

Path: cli.compare.run → logbook.compare.compare
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.disk import replacing
from fdi_torch.jobs.report import plant_of
from fdi_torch.logbook import Comparison, compare, read_run
from fdi_torch.report.comparison import comparison_section, in_words, result_table
from fdi_torch.report.comparison_headline import comparison_headline, left_out_words, setting_differences
from fdi_torch.report.material import Material, gather
from fdi_torch.report.style import save

MOST_TEXT = 40


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    comparison = compare(arguments.logs)
    runs, headline = show(comparison, arguments.logs, screen)
    if arguments.csv:
        with replacing(Path(arguments.csv)) as new, new.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(comparison.rows())
        screen.say(f"table: {arguments.csv}")
    if arguments.pictures:
        section = comparison_section(comparison, runs)
        for picture in section.pictures:
            for ending in (".png", ".svg"):
                save(picture.figure, Path(arguments.pictures) / f"{picture.name}{ending}")
        screen.say(f"{len(section.pictures)} pictures: {arguments.pictures}")
    screen.result({"format": "fdi_torch.compare/1", "comparison": comparison, "headline": headline})
    return DONE


def show(comparison: Comparison, logs: Sequence[str | Path], screen: Screen) -> tuple[list[Material], list[str]]:
    """Print the comparison in the units of the first run. Returns the runs, and the headline as sentences."""
    runs = [gather(log, plant_of(log, [])) for log in map(read_run, logs)]
    with runs[0].in_its_units():
        headline = comparison_headline(comparison, runs)
        for sentence in (*headline, *in_words(comparison)):
            screen.say(sentence)
        _show_tables(comparison, runs, screen)
    return runs, headline


def _show_tables(comparison: Comparison, runs: Sequence[Material], screen: Screen) -> None:
    settings, left_out = setting_differences(comparison, runs)
    rows = [[key, *(text[:MOST_TEXT] for text in texts)] for key, texts in settings.items()]
    if rows and len({run.kind for run in runs}) == 1:  # runs of different kinds have different keys
        screen.say()
        screen.table("settings", ("key", *comparison.labels), rows, left=1 + len(comparison.labels))
        if left_out:
            screen.say(left_out_words(left_out))
    if comparison.results:
        screen.say()
        screen.table("estimates", *result_table(comparison), left=2)
