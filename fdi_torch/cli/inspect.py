"""`fdi inspect`: what it does and prints. Its options: `options/inspect.py`.

Path: cli.inspect.run → logbook.export.inspect_log → logbook.export.export
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import orjson

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.disk import named_errors, write_text
from fdi_torch.logbook import Inspection, export, export_attachment, foxglove_layout, inspect_log, read_run
from fdi_torch.logbook.reader import AT_BOUNDS, RANGES, ranges_of
from fdi_torch.names import counted
from fdi_torch.report.numbers import correlation_table, estimate_table
from fdi_torch.tables import Table

MOST_RESULTS, MOST_COLUMNS = 12, 11
ESTIMATE = ("names", "units", "value", "std", "covariance", "covariance_shape")  # results that are shown as tables
DRAWS = ("draws.parameter", "draws.unit", "draws.median", "draws.std")
IN_SI = {"noise_std": "noise_std, SI"}
_FRACTION = re.compile(r"(?<=T\d\d:\d\d:\d\d)\.\d+")
RECORDS = ("run", "status", "data", "seeds", "git")


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    if arguments.attachment is not None:
        path = export_attachment(read_run(arguments.log, salvage=True), arguments.attachment, arguments.out or ".")
        screen.note(f"attachment: {path}")
    elif arguments.layout is not None:
        write_layout(arguments, screen)
    elif arguments.topic is not None:
        write_topic(arguments, screen)
    else:
        inspection = inspect_log(arguments.log)
        show(inspection, screen)
        screen.result(as_json(inspection))
    return DONE


def write_topic(arguments: argparse.Namespace, screen: Screen) -> None:
    """Write the messages of a topic to a new file or to standard output."""
    log = read_run(arguments.log, salvage=True)
    if arguments.out is None:
        with screen.stream() as stream:
            count = export(log, arguments.topic, arguments.format, stream)
    else:
        path = Path(arguments.out)
        with named_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as file:
                try:
                    count = export(log, arguments.topic, arguments.format, file)
                except OSError:
                    path.unlink()
                    raise
    screen.note(f"{counted(count, 'message')} of {arguments.topic}: {arguments.out or 'standard output'}")


def write_layout(arguments: argparse.Namespace, screen: Screen) -> None:
    """Write the layout that shows this log in Foxglove or Lichtblick; an existing file is replaced."""
    path = Path(arguments.layout)
    layout = foxglove_layout(read_run(arguments.log, salvage=True))
    write_text(path, orjson.dumps(layout, option=orjson.OPT_INDENT_2).decode() + "\n")
    screen.say(f"layout: {path}; in Foxglove or Lichtblick, open {arguments.log}, then import the layout")
    screen.result({"format": "fdi_torch.inspect/1", "path": str(arguments.log), "layout": str(path)})


def show(inspection: Inspection, screen: Screen) -> None:
    """Print run, data, result, topics and integrity of the log."""
    kind = inspection.about.get("run", {}).get("kind", "")
    log = f"a log of fdi {kind}" if kind else "a foreign MCAP file"
    screen.say(f"{inspection.path}: {log}, written by {inspection.library}")
    for record in RECORDS:
        values = {name: value for name, value in inspection.about.get(record, {}).items() if value}
        if values:
            words = (f"{name} {_FRACTION.sub('', value)}" for name, value in values.items())
            screen.say(f"{record:<8}{', '.join(words)}")
    result = inspection.about.get("result", {})
    tables = estimate_tables(result)
    results = [
        (IN_SI.get(name, name), result_text(text))
        for name, text in result.items()
        if not (tables and (name in (*ESTIMATE, *DRAWS) or name.startswith(RANGES)))
    ]
    results = [(name, text) for name, text in results if text]
    for name, text in results[:MOST_RESULTS]:
        screen.say(f"result  {name} {text[:100]}")
    if len(results) > MOST_RESULTS:
        screen.say(f"result  and {len(results) - MOST_RESULTS} more: --json shows all")
    for table in (*tables, inspection.table()):
        screen.say()
        screen.show(table)
    for item in inspection.attachments.values():
        screen.say(f"attachment {item.name}, {item.size} bytes")
    screen.say()
    state = "intact: all CRCs, indices and counts agree" if inspection.health.sound else "damaged"
    screen.say(f"{inspection.content}; {state}")
    for sentence in (*inspection.health.problems, inspection.advice):
        if sentence:
            screen.say(f"- {sentence}")


def estimate_tables(result: Mapping[str, str]) -> list[Table]:
    """Tables of the estimates, of their correlations if they are few, and of the draws; none if one is unreadable."""
    try:
        *estimates, covariance = (orjson.loads(result.get(key, "[]")) for key in ESTIMATE[:5])
        ends = {key.removeprefix(AT_BOUNDS): end for key, end in result.items() if key.startswith(AT_BOUNDS)}
        drawn = [orjson.loads(result.get(key, "[]")) for key in DRAWS]
        tables = [estimate_table("estimates", *estimates, ends=ends, ranges=ranges_of(result))]
        tables.append(estimate_table("draws: median and standard deviation", *drawn))
        matrix = np.array(covariance, dtype=float).reshape(len(estimates[0]), -1)
        if matrix.shape == (len(matrix),) * 2 and len(matrix) > 1:
            tables.insert(1, correlation_table(estimates[0], matrix))
    except (ValueError, TypeError, AttributeError):
        return []
    return [table for table in tables if len(table.header) <= MOST_COLUMNS]


def result_text(text: str) -> str:
    """A result in words: numbers with four digits; empty for an empty list."""
    with suppress(ValueError):
        value = orjson.loads(text)
        if isinstance(value, float):
            return f"{value:.4g}"
        if isinstance(value, list) and all(isinstance(each, int | float | str) for each in value):
            return ", ".join(f"{each:.4g}" if isinstance(each, float) else str(each) for each in value)
    return text


def as_json(inspection: Inspection) -> dict[str, object]:
    return {
        "format": "fdi_torch.inspect/1",
        "path": str(inspection.path),
        "size": inspection.size,
        "ours": inspection.ours,
        "about": inspection.about,
        "other_metadata": inspection.other_metadata,
        "topics": list(inspection.topics.values()),
        "attachments": {name: item.size for name, item in inspection.attachments.items()},
        "sound": inspection.health.sound,
        "problems": list(inspection.health.problems),
    }
