"""Make one HTML page of one or more logs: verdict, rig, readings, convergence, uncertainty, configuration, provenance.

The page needs no network and no scripts. It is written beside the (first) log, or where --out says.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.config.logged import logged_plant
from fdi_torch.logbook import Run, compare, read_run
from fdi_torch.plant.description import PlantDescription
from fdi_torch.report.comparison import comparison_section
from fdi_torch.report.material import gather
from fdi_torch.report.page import RunReport, page, report_of, write_pictures
from fdi_torch.report.section import Section
from fdi_torch.report.verdict import headline


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="RUN.mcap", help="logs, which may be unfinished or damaged")
    parser.add_argument("--out", metavar="FILE|DIR", help="the page, or the folder for it")
    parser.add_argument("--pictures", action="store_true", help="also write every picture as PNG and SVG")


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    target = page_path([Path(name) for name in arguments.logs], arguments.out)
    reports = []
    with screen.progress("report") as advance:
        for k, name in enumerate(arguments.logs):
            log = read_run(name, salvage=True)
            reports.append(report_of(gather(log, plant_of(log, screen))))
            advance((k + 1) / (len(arguments.logs) + 1), log.path.name)
        target.parent.mkdir(parents=True, exist_ok=True)
        first = [together(reports)] if len(reports) > 1 else []
        target.write_text(page(reports, first), encoding="utf-8", errors="replace")
        pictures = []
        for k, report in enumerate(reports if arguments.pictures else ()):
            several = f"{k + 1}_" if len(reports) > 1 else ""
            pictures += write_pictures(report, target.with_suffix("") / several if several else target.with_suffix(""))
        advance(1.0)
    for report in reports:
        screen.say(f"{report.material.run.path}: {headline(report.material)}")
    screen.say(f"page: {target}")
    if pictures:
        screen.say(f"{len(pictures)} pictures: {target.with_suffix('')}")
    screen.result({"format": "fdi_torch.report/1", "page": str(target), "pictures": [str(path) for path in pictures]})
    return DONE


def together(reports: Sequence[RunReport]) -> Section:
    """The comparison of all runs; what stands in its way where they cannot be compared."""
    runs = [report.material for report in reports]
    try:
        return comparison_section(compare([run.run.path for run in runs]), runs)
    except (ValueError, KeyError, TypeError, IndexError, OSError) as error:
        return Section("Comparison", [f"These logs cannot be compared: {error}"])


def page_path(logs: list[Path], out: str | None) -> Path:
    """Where the page goes: never over a log."""
    name = logs[0].name.removesuffix(".partial").removesuffix(".mcap") + ("_and_more" if len(logs) > 1 else "")
    if out is None:
        return logs[0].with_name(f"{name}.html")
    path = Path(out)
    if path.is_dir() or not path.suffix:
        return path / f"{name}.html"
    if path.suffix not in (".html", ".htm"):
        raise ValueError(f"expected a page that ends in .html, or a folder, got {out}; rename it")
    return path


def plant_of(log: Run, screen: Screen) -> PlantDescription | None:
    """The plant that the log describes; a page can do without, and a withheld check may be of many rigs."""
    if log.metadata.get("fdi_torch.run", {}).get("kind") == "challenge":
        return None
    try:
        return logged_plant(log)
    except (ValueError, OSError) as error:
        screen.note(f"no drawing of the rig: {error}")
        return None
