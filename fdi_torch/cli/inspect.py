"""`fdi inspect`: what it does and prints. Its options: `options/inspect.py`.

Path: cli.inspect.run → logbook.inspect.inspect_log → logbook.export.export
"""

from __future__ import annotations

import argparse
from pathlib import Path

import orjson

from fdi_torch.cli import DONE
from fdi_torch.cli.screen import Screen
from fdi_torch.disk import named_errors, write_text
from fdi_torch.logbook import Inspection, export, export_attachment, foxglove_layout, inspect_log, read_run

MOST_RESULTS = 12
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
    screen.note(f"{count} messages of {arguments.topic}: {arguments.out or 'standard output'}")


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
            screen.say(f"{record:<8}{', '.join(f'{name} {value}' for name, value in values.items())}")
    results = list(inspection.about.get("result", {}).items())
    for name, value in results[:MOST_RESULTS]:
        screen.say(f"result  {name} {value[:100]}")
    if len(results) > MOST_RESULTS:
        screen.say(f"result  and {len(results) - MOST_RESULTS} more")
    rows = [
        [info.topic, info.schema, str(info.messages), f"{info.first:.6g}", f"{info.last:.6g}", str(info.size)]
        for info in inspection.topics.values()
    ]
    screen.say()
    screen.table("", ("topic", "schema", "messages", "from, s", "to, s", "bytes"), rows, left=2)
    for item in inspection.attachments.values():
        screen.say(f"attachment {item.name}, {item.size} bytes")
    screen.say()
    state = "intact: all CRCs, indices and counts agree" if inspection.health.sound else "damaged"
    screen.say(f"{inspection.size} bytes, {inspection.messages} messages in {inspection.health.chunks} chunks; {state}")
    for sentence in (*inspection.health.problems, inspection.advice):
        if sentence:
            screen.say(f"- {sentence}")


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
